"""Rendered eyes of SCENE.toml, or a picture through a lens."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands import Output
from metalens.commands.picture import PictureOptions

WORK = "codesign.commands.scene"


@dataclass(frozen=True)
class Options(PictureOptions):
    """Options of ``metalens scene``.

    Attributes:
        config: SCENE.toml; without it the defaults. With --image the lens (lens.h5).
        output: folder for scene.h5, sheet.png and labels.csv; with --lens
            also image.h5 and image.png; with --image for image.h5 and sensor.png.
        lens: a lens that images the first frames onto its sensor, over the whole field
            and in its light: scene, image,
            their difference, and the PSFs over field and depth. Ends 1 where the
            image's error is above 0.03.
    """

    config: tyro.conf.Positional[Path | None] = None
    output: Output = Path("scene")
    lens: Path | None = None
