"""lens.h5 to a page over field and wavelength."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.lens_report"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens lens-report``.

    Attributes:
        lens: the lens file.
        output: the page to write; NAME.json with all numbers is written next to it.
        angles_deg: field angles along x; left out, five from 0 to the half field over
            which a hyperbolic lens of this focus is diffraction-limited.
        wavelengths_nm: in vacuum; left out, the design wavelength.
        depth_mm: of the source, inf for collimated light; left out, the focus of the
            lens.
        frequencies_per_mm: of the MTF; left out, an eighth, a quarter and a half of
            2 NA / wavelength.
        tolerance: relative L2 error of the PSFs.
    """

    lens: tyro.conf.Positional[Path]
    output: Output = Path("lens_report.html")
    angles_deg: tuple[float, ...] = ()
    wavelengths_nm: tuple[float, ...] = ()
    depth_mm: float | None = None
    frequencies_per_mm: tuple[float, ...] = ()
    tolerance: float = 1e-3
