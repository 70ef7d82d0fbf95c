"""One grey picture of a file: a micrograph or an edge, as microscopes and image
programs save them.
"""

from pathlib import Path

import numpy as np

from characterize.captures import capture
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

# share of pixels whose colours are one grey: the rest is writing in the picture
_ALIKE = 0.9
_FLAT, _NOISY = (
    0.5,
    0.25,
)  # share of a row's pixels of one value: of a strip, from; of a picture, to


def read_picture(path: Path) -> Array:
    """(y, x) the one picture of a TIFF, PNG or HDF5 file; of equal colours,
    red.

    Microscopes save grey pictures with three equal colours, and write into them in
    yellow or green.

    Args:
        path: the file.

    Raises:
        CaptureError: as :func:`characterize.captures.capture.read_images`; several
            pictures, or one in colours.
    """
    images = capture.read_all(path).images
    if len(images) != 1:
        raise CaptureError(f"{path}: {len(images)} pictures; need one")
    if images.ndim == 3:
        return np.asarray(capture.check_images(images, path)[0])
    colours = images[0, ..., :3]
    grey = (colours == colours[..., :1]).all(-1).mean()
    if grey < _ALIKE:
        raise CaptureError(
            f"{path}: in colours ({1 - grey:.0%} of the pixels are not grey); save it in grey"
        )
    return np.asarray(colours[..., 0])


def without_strip(image: Array) -> Array:
    """The picture without the strip of writing that a microscope adds below it.

    Rows of it are of one value but for letters and a bar, where noise gives a picture's
    rows many. A picture whose own
    rows are of few values stays as it is.

    Args:
        image: (y, x) picture.
    """
    share = (image == np.median(image, axis=1, keepdims=True)).mean(1)
    pictured = np.flatnonzero(share < _FLAT)
    last = int(pictured[-1]) + 1 if len(pictured) else len(image)
    return image[:last] if np.median(share[:last]) <= _NOISY else image


def crop_picture(image: Array, crop: tuple[int, int, int, int] | None) -> Array:
    """The picture cut to a rectangle; whole without one.

    Args:
        image: (y, x) picture.
        crop: (top, bottom, left, right) pixels, or None.

    Raises:
        CaptureError: fewer than 20 pixels along a side are left.
    """
    if crop is None:
        return image
    top, bottom, left, right = crop
    part = image[top:bottom, left:right]
    if min(part.shape) < 20:
        raise CaptureError(
            f"crop {crop} of a picture of {image.shape} leaves {part.shape}; need 20 "
            "pixels or more"
        )
    return part
