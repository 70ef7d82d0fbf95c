"""RUN.toml to RUN_DIR: lens, pixel pitch and network trained together, then searched
under compute budgets.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from codesign.settings import Part, Place
from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.codesign"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens codesign``.

    Attributes:
        config: RUN.toml.
        output: folder of the run.
        resume: go on from the folder's checkpoint, bit for bit.
        freeze: parts that stay as they start, besides those of the config: the
            ablations.
        device: of images and network; auto takes a GPU where there is one. Frames are
            rendered on the processor.
        export: write every budget's network as ONNX too (opset 17): frames of the
            sensor's pixels in; pupil, slippage,
            landmarks in mm and the angles of the optic axis out, which gaze is
            calibrated from.
        events: write TensorBoard events too (scalars of every step).
    """

    config: tyro.conf.Positional[Path]
    output: Output = Path("run")
    resume: bool = False
    freeze: tuple[Part, ...] = ()
    device: Place = "auto"
    export: bool = False
    events: bool = False
