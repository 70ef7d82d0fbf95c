"""Pictures as microscopes and image programs save them: the same grey values from every
way of writing them.
"""

import numpy as np
import pytest
import tifffile
from PIL import Image

from characterize.measure import picture
from metalens.core.errors import CaptureError

GREY = np.random.default_rng(6).integers(3, 250, (23, 31)).astype(np.uint8)
COLOURS = np.stack([GREY] * 3, -1)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA"])
def test_a_png_of_any_kind_holds_the_same_picture(tmp_path, mode):
    Image.fromarray(GREY).convert(mode).save(tmp_path / "a.png")
    assert np.array_equal(picture.read_picture(tmp_path / "a.png"), GREY)


def test_writing_in_a_grey_picture_of_colours_leaves_the_rest(tmp_path):
    written = COLOURS.copy()
    written[2:6, 3:15] = (255, 220, 0)  # 48 of 713 pixels: 7 %
    tifffile.imwrite(tmp_path / "a.tif", written, photometric="rgb")
    found = picture.read_picture(tmp_path / "a.tif")
    assert np.array_equal(found[6:], GREY[6:])
    assert (found[2:6, 3:15] == 255).all()


def test_a_strip_of_writing_below_is_left_out():
    strip = np.full((9, 31), 12, np.uint8)
    strip[3:5, 4:17] = 255
    strip[6, 20:29:2] = 200
    assert np.array_equal(picture.without_strip(np.concatenate([GREY, strip])), GREY)
    assert np.array_equal(picture.without_strip(GREY), GREY)


def test_a_coloured_picture_and_a_stack_are_refused_by_name(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", COLOURS * np.array([1, 2, 3], np.uint8), photometric="rgb"
    )
    with pytest.raises(
        CaptureError,
        match=r"a.tif: in colours \(\d+% of the pixels are not grey\); save it in grey",
    ):
        picture.read_picture(tmp_path / "a.tif")
    tifffile.imwrite(tmp_path / "b.tif", np.stack([GREY] * 5), photometric="minisblack")
    with pytest.raises(CaptureError, match="5 pictures; need one"):
        picture.read_picture(tmp_path / "b.tif")
