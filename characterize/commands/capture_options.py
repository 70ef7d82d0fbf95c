"""Virtual bench: lens.h5 and a hidden truth -> a capture folder (TIFF frames,
stage.csv, dark, flat, capture.toml).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from metalens.commands import DistributedOptions, Output

WORK = "characterize.commands.capture"


@dataclass(frozen=True)
class Options(DistributedOptions):
    """Options of ``metalens capture``: either --truth or --protocol.

    Attributes:
        lens: the designed lens.
        output: folder of captures to write; with --protocol the stage.csv of the frames
            to take.
        truth: TOML of the hidden as-built lens and of its captures (depths_um,
            parameter, camera ...).
        protocol: TOML of what a real bench can do (depths_um, angles_deg, exposures,
            frames, peak_e ...): nothing is
            captured, the frames that tell most about the lens are listed, with the
            errors to expect; only as many as
            the intervals that it wants ([[wanted]] name, within) need. --plan is the
            same.
    """

    lens: tyro.conf.Positional[Path]
    output: Output
    truth: Path | None = None
    protocol: Annotated[Path | None, tyro.conf.arg(aliases=["--plan"])] = None
