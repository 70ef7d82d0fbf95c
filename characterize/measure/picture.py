"""One grey picture of a file: a micrograph or an edge, as microscopes and image programs save them."""

from pathlib import Path

import numpy as np

from characterize.captures import capture
from metalens.ground.arrays import Array
from metalens.ground.errors import CaptureError

_ALIKE = 0.9  # share of pixels whose colours are one grey: the rest is writing in the picture


def read(path: Path) -> Array:
    """(y, x) the one picture of a TIFF, PNG or HDF5 file; of colours that are alike, red.

    Microscopes save grey pictures with three equal colours, and write into them in yellow or green.

    Raises:
        CaptureError: as :func:`characterize.captures.capture.read_images`; several pictures, or one in colours.
    """
    images = capture.read_all(path)
    if len(images) != 1:
        raise CaptureError(f"{path}: {len(images)} pictures; need one")
    if images.ndim == 3:
        return np.asarray(capture.read_images(path)[0])
    colours = images[0, ..., :3]
    grey = (colours == colours[..., :1]).all(-1).mean()
    if grey < _ALIKE:
        raise CaptureError(f"{path}: in colours ({1 - grey:.0%} of the pixels are not grey); save it in grey")
    return np.asarray(colours[..., 0])
