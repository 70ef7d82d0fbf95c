"""Raw colour mosaics taken apart, and values of TIFF files that are not light."""

import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

sys.path.insert(0, str(Path(__file__).parents[1]))

from characterize.captures import capture
from metalens.core.errors import CaptureError

RAW = np.random.default_rng(31).integers(40, 900, (3, 11, 14)).astype(np.uint16)


def folder(path, about, **tags):
    for i, frame in enumerate(RAW):
        tifffile.imwrite(path / f"f{i}.tif", frame, **tags)
    tifffile.imwrite(path / "dark.tif", RAW[:2] // 9)
    (path / "capture.toml").write_text(
        f"bits = 12\npixel_um = 1.7\npixel_sigma_um = 0.034\n{about}\n"
    )
    return path


@pytest.mark.parametrize(
    ("mosaic", "channel", "first"),
    [
        ("RGGB", "red", (0, 0)),
        ("RGGB", "green", (0, 1)),
        ("grbg", "blue", (1, 0)),
        ("BGGR", "red", (1, 1)),
    ],
)
def test_the_lit_colour_of_a_mosaic_is_taken_at_twice_the_pitch(
    tmp_path, mosaic, channel, first
):
    path = folder(
        tmp_path, f'channel = "{channel}"\nmosaic = "{mosaic}"', photometric=32803
    )
    found = capture.load(path)
    row, column = first
    assert np.array_equal(found.frames, RAW[:, row::2, column::2])
    assert np.array_equal(found.dark, RAW[:2, row::2, column::2] // 9)
    assert (found.pixel_um, found.fill) == (3.4, 0.5)
    assert any("one pixel in four" in words for words in found.corrections)


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ('mosaic = "RGGB"', r"mosaic without the colour that is lit"),
        ('channel = "green"\nmosaic = "RGB"', r"mosaic = 'RGB'; need the 2 x 2 pixels"),
        ('channel = "green"\nmosaic = "RRGB"', r"mosaic = 'RRGB'; need"),
        ('channel = "green"', r'mosaic = "RGGB"'),
    ],
)
def test_a_mosaic_that_is_said_in_part_is_refused(tmp_path, about, words):
    with pytest.raises(CaptureError, match=words):
        capture.load(folder(tmp_path, about))


def test_colours_that_were_put_together_are_no_mosaic(tmp_path):
    tifffile.imwrite(tmp_path / "f.tif", np.stack([RAW] * 3, -1)[0], photometric="rgb")
    (tmp_path / "f.toml").write_text('channel = "red"\nmosaic = "RGGB"\n')
    with pytest.raises(CaptureError, match="put together already"):
        capture.load(tmp_path / "f.tif")


@pytest.mark.parametrize(
    ("meaning", "words"),
    [
        (32803, r'CFA.*mosaic = "RGGB"'),
        ("miniswhite", r"white is 0.*in which black is 0"),
    ],
)
def test_values_that_are_not_light_are_refused_by_name(tmp_path, meaning, words):
    with pytest.raises(CaptureError, match=words):
        capture.load(folder(tmp_path, "", photometric=meaning))


def test_places_in_a_table_of_colours_are_no_light(tmp_path):
    table = np.zeros((3, 256), np.uint16)
    tifffile.imwrite(
        tmp_path / "f.tif",
        RAW[0].astype(np.uint8),
        photometric="palette",
        colormap=table,
    )
    with pytest.raises(CaptureError, match="table of colours"):
        capture.load(tmp_path / "f.tif")
