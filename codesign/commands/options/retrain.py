"""RUN_DIR and asbuilt.h5 to DIR: the network trained on for the lens that was made, and
the next mask's correction.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from codesign.settings import Place, RetrainConfig
from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.retrain"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens retrain``.

    Attributes:
        run_dir: folder of a finished ``metalens codesign``.
        asbuilt: what ``metalens fit`` made of captures of the run's lens.h5.
        output: folder for the retrained network, result.json, bias.toml,
            lens_corrected.h5 and report.html.
        truth: TOML of the virtual bench; then the true lens judges, and a network is
            trained with it known.
        process: PROCESS.toml that the mask was drawn with; its bias table is the one to
            be corrected.
        settings: how to train on.
        resume: go on from the folder's checkpoints, bit for bit.
        device: of images and network, as in ``metalens codesign``.
        export: write the retrained network as ONNX too, as ``metalens codesign
            --export`` does.
        insist: use a fit that failed its own checks.
    """

    run_dir: tyro.conf.Positional[Path]
    asbuilt: Annotated[Path, tyro.conf.arg(aliases=["--optics"])]
    output: Output
    truth: Path | None = None
    process: Path | None = None
    settings: tyro.conf.OmitArgPrefixes[RetrainConfig] = field(
        default_factory=RetrainConfig
    )
    resume: bool = False
    device: Place = "auto"
    export: bool = False
    insist: bool = False
