"""Pixel size of a micrograph from the instrument's tags, written by hand."""

import numpy as np
import pytest
import tifffile

from characterize.measure import sem
from metalens.core.errors import CaptureError

IMAGE = np.arange(30 * 40, dtype=np.uint8).reshape(30, 40)
ZEISS = (
    "\r\n0\r\n0\r\n0\r\nAP_MAG\r\nMag = 50.00 K X\r\n"
    "AP_PIXEL_SIZE\r\nPixel Size = 2.233 nm\r\n"
)
FEI = "[User]\r\nDate=1\r\n[Scan]\r\nPixelWidth={}\r\nPixelHeight={}\r\n"


def write(path, tag, text):
    tags = [(tag, "s", 0, text, True)]
    tifffile.imwrite(path, IMAGE, extratags=tags, photometric="minisblack")
    return path


def test_zeiss_and_fei_tags_give_the_pixel(tmp_path):
    path = write(tmp_path / "z.tif", 34118, ZEISS)
    assert sem.instrument_pixel_nm(path) == pytest.approx(2.233, rel=1e-12)
    for tag in (34680, 34682):
        path = write(tmp_path / "f.tif", tag, FEI.format("3.7e-09", "3.7e-09"))
        assert sem.instrument_pixel_nm(path) == pytest.approx(3.7, rel=1e-12)


def test_no_tag_is_no_pixel_and_an_oblong_one_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", IMAGE, photometric="minisblack")
    assert sem.instrument_pixel_nm(tmp_path / "a.tif") is None
    (tmp_path / "b.tif").write_bytes(b"no picture")
    assert sem.instrument_pixel_nm(tmp_path / "b.tif") is None
    path = write(tmp_path / "f.tif", 34682, FEI.format("3.7e-09", "4.1e-09"))
    with pytest.raises(CaptureError, match="need square ones"):
        sem.instrument_pixel_nm(path)
