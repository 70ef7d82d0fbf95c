"""Bench captures -> the lens (or the pupil) that made them, with intervals,
degeneracies and a report.

An interruption leaves what stood at the output; the same command begins the fit
(minutes) anew, but for its pillars,
which are kept in the cache folder of the user.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands import CommonOptions, Output

WORK = "characterize.commands.fit"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens fit``: either --design or --pupil.

    Attributes:
        capture: folder, or TIFF, PNG or HDF5 stack.
        design: lens file of the metalens that was captured.
        metrology: TOML of other measurements (``[[known]]`` name, value, sigma) and of
            what to fit beyond the usual.
        pupil: TOML of what is known of a generic lens (numerical_aperture,
            wavelength_um, pixel_um, step_um ...).
        truth: TOML of a virtual bench (that of ``capture --truth``): its hidden values
            are drawn in the report.
        next_mask: write the correction of the next mask too: bias.toml, bias.csv and
            lens_corrected.h5, each after the name of the output; exit 1 where the
            posterior is too wide or the predicted gain is negative.
        process: PROCESS.toml of the present mask, whose bias the correction starts
            from.
        insist: write a result that fails its checks too (exit 1, problems listed).
        output: file to write; a report lies beside it as .html.
    """

    capture: tyro.conf.Positional[Path]
    output: Output
    design: Path | None = None
    metrology: Path | None = None
    pupil: Path | None = None
    truth: Path | None = None
    next_mask: bool = False
    process: Path | None = None
    insist: bool = False
