"""Pictures as microscopes and image programs save them: the same grey values from every
way of writing them.
"""

import numpy as np
import pytest
import tifffile
from PIL import Image

from characterize.captures import capture
from characterize.measure import picture
from metalens.core.errors import CaptureError

GREY = np.random.default_rng(6).integers(3, 250, (23, 31)).astype(np.uint8)
COLOURS = np.stack([GREY] * 3, -1)
RAMP = np.stack([np.arange(256, dtype=np.uint16) * 257] * 3)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA"])
def test_a_png_of_any_kind_holds_the_same_picture(tmp_path, mode):
    Image.fromarray(GREY).convert(mode).save(tmp_path / "a.png")
    assert np.array_equal(picture.read_picture(tmp_path / "a.png"), GREY)


@pytest.mark.parametrize("step", [257, 256])
def test_a_tiff_with_a_table_of_greys_holds_what_a_plain_one_holds(tmp_path, step):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, GREY, photometric="palette", colormap=RAMP // 257 * step)
    assert np.array_equal(picture.read_picture(path), GREY)
    assert np.array_equal(capture.load(path).frames[0], GREY)


def test_a_table_of_other_colours_or_another_order_is_refused(tmp_path):
    coloured = RAMP * np.array([[1], [1], [0]], np.uint16)
    for table in (coloured, RAMP[:, ::-1].copy(), (RAMP / 257) ** 2):
        tifffile.imwrite(
            tmp_path / "a.tif",
            GREY,
            photometric="palette",
            colormap=table.astype(np.uint16),
        )
        with pytest.raises(CaptureError, match="table of colours"):
            picture.read_picture(tmp_path / "a.tif")


def test_sixteen_bits_of_either_order_of_bytes_are_read(tmp_path):
    deep = GREY.astype(np.uint16) * 257 + 5
    for order in "<>":
        tifffile.imwrite(
            tmp_path / "a.tif", deep, byteorder=order, photometric="minisblack"
        )
        assert np.array_equal(picture.read_picture(tmp_path / "a.tif"), deep)


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


def test_dark_gaps_of_a_clean_picture_are_no_strip():
    """Gaps of nothing, six rows high, between rows of pillars that leave most of a row
    dark: all of it stays.
    """
    y, x = np.indices((60, 70))
    clean = np.where(np.hypot(y % 20 - 9.5, x % 20 - 9.5) < 7, 200, 0).astype(np.uint8)
    assert np.array_equal(picture.without_strip(clean), clean)


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
