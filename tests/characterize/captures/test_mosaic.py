"""Raw colour mosaics taken apart, and values of TIFF files that are not light."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures import capture
from characterize.inference import prepare
from characterize.model.detector import DetectorGrid, detector_transfers
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


def test_an_error_of_the_pitch_is_the_same_share_of_a_mosaic(tmp_path):
    """0.034 of 1.7 um: 2 %, at either pitch."""
    found = capture.load(
        folder(tmp_path, 'channel = "green"\nmosaic = "GBRG"\nwavelength_um = 0.85')
    )
    known = {k.name: k for k in prepare.stated_priors(found, b.row())}
    assert known["pixel_percent"].sigma == pytest.approx(2.0)
    placed = dataclasses.replace(found, position_um=np.array([400.0, 500.0, 600.0]))
    assert prepare.setting_of(placed, 48)[0].fill == 0.5


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


def test_a_pixel_of_a_mosaic_is_half_as_wide_as_its_pitch():
    """Every second of small pixels: the same numbers as those of the whole sensor, half
    a pixel off, to rounding.
    """
    light = np.random.default_rng(5).normal(size=(2, 2 * 4 * (9 + 4), 2 * 4 * (7 + 4)))
    whole = DetectorGrid(18, 14, 1.7, 4, margin=4)
    part = DetectorGrid(9, 7, 3.4, 8, margin=2, fill=0.5)
    for blur, size in ((0.3, 0.0), (0.3, 2.1)):
        sizes = np.full(2, size)
        every = whole.sample(
            np.roll(light, (2, 2), (1, 2)),
            detector_transfers(whole, blur, sizes, np.ones(2))[0],
        )
        some = part.sample(light, detector_transfers(part, blur, sizes, np.ones(2))[0])
        assert _nearest(some, every) < 1e-9


def _nearest(some, every):
    """Largest difference to every second pixel, whichever these are."""
    return min(abs(some - every[:, a::2, b::2]).max() for a in (0, 1) for b in (0, 1))
