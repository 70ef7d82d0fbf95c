"""SCENE.toml to rendered eyes: a contact sheet, masks and labels."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.scene"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens scene``.

    Attributes:
        config: SCENE.toml; without it the defaults.
        output: folder for scene.h5, sheet.png and labels.csv; with --lens
            also image.h5 and image.png.
        lens: a lens that images the first frames onto its sensor, over the whole field
            and in its light: scene, image,
            their difference, and the PSFs over field and depth. Ends 1 where the
            image's error is above 0.03.
        fwhm_nm: width of that light, 0 for one wavelength.
    """

    config: tyro.conf.Positional[Path | None] = None
    output: Output = Path("scene")
    lens: Path | None = None
    fwhm_nm: float = 0.0
