"""SCENE.toml to rendered eyes: a contact sheet, masks and labels; or a picture through a
lens.
"""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.scene"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens scene``.

    Attributes:
        config: SCENE.toml; without it the defaults. With --image the lens (lens.h5).
        output: folder for scene.h5, sheet.png and labels.csv; with --lens
            also image.h5 and image.png; with --image for image.h5 and sensor.png.
        lens: a lens that images the first frames onto its sensor, over the whole field
            and in its light: scene, image,
            their difference, and the PSFs over field and depth. Ends 1 where the
            image's error is above 0.03.
        fwhm_nm: width of that light, 0 for one wavelength.
        image: a picture (grey or colour, values as radiance) that the lens images, in
            place of eyes.
        depth_mm: distance of the picture from the lens, inf for what is far away.
        width_mm: width of the picture; left out: the lens's field of view.
        tolerance: relative L2 error of the picture's image. Ends 1 above it.
    """

    config: tyro.conf.Positional[Path | None] = None
    output: Output = Path("scene")
    lens: Path | None = None
    fwhm_nm: float = 0.0
    image: Path | None = None
    depth_mm: float = field(default=0.0, metadata={"may_be_inf": True})
    width_mm: float = 0.0
    tolerance: float = 0.03
