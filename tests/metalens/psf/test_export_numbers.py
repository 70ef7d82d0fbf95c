"""Stacks of all kinds of axes in files of other programs: scales, places and orders, by
numbers that are typed in.
"""

import dataclasses
import io
import json
import struct

import numpy as np
import pytest
import tifffile
from scipy.io import loadmat

from metalens.psf import PsfStack, export
from tests.metalens.psf.test_psf_export import _units

LIGHT = np.arange(1.0, 1 + 2 * 3 * 4 * 5).reshape(2, 3, 4, 5)  # angle, depth, y, x


def stack(light=LIGHT, angles=2):
    lead = light.shape[:-2]
    return PsfStack(
        light,
        np.arange(7.0, 7 + np.prod(lead)).reshape(lead),
        depths_um=np.array([np.inf, 900.0, 1300.0]),
        angles_rad=np.array([[0.1, -0.2], [0.3, 0.05]])[:angles],
        wavelengths_um=np.array([0.83, 0.87]),
        weights=np.array([0.3, 0.7]),
        step_um=0.8,
        centres_um=np.array([[12.0, -24.0], [37.0, 6.0]])[:angles],
        sensor_distance_um=123.0,
        tolerance=2e-4,
        error=3e-5,
        reason="by hand",
    )


@pytest.mark.parametrize(
    ("shape", "angles", "words"),
    [
        ((3, 4, 5), 1, "depth y x"),
        ((3, 4, 1), 1, "depth y x"),  # a single column is no angle
        ((2, 3, 4, 5), 2, "angle depth y x"),
        ((4, 3, 4, 5), 2, "lens depth y x"),
        ((7, 2, 3, 4, 5), 2, "lens angle depth y x"),
        ((7, 6, 3, 4, 5), 2, "lens lens depth y x"),
        ((7, 6, 2, 3, 4, 5), 2, "lens lens angle depth y x"),
    ],
)
def test_axes_are_named_slowest_first(shape, angles, words):
    assert export._axes(stack(np.ones(shape), angles)) == words


def test_tiff_pages_run_over_depth_first_and_have_their_scale_in_centimetres():
    """0.8 um: 12500 a centimetre. A depth at infinity is null, and all numbers stand
    beside the axes.
    """
    with tifffile.TiffFile(io.BytesIO(export.write_tiff(stack()))) as file:
        pages, tags = [page.asarray() for page in file.pages], file.pages[0].tags
        about = json.loads(file.pages[0].description)
    assert np.array_equal(np.stack(pages), LIGHT.reshape(6, 4, 5))
    for name in ("XResolution", "YResolution"):
        above, below = tags[name].value
        assert above / below == pytest.approx(12_500, rel=1e-6)
    assert tags["ResolutionUnit"].value == 3  # centimetres, by the standard
    want = {
        "step_um": 0.8,
        "sensor_distance_um": 123.0,
        "tolerance": 2e-4,
        "error": 3e-5,
        "reason": "by hand",
        "depths_um": [None, 900.0, 1300.0],
        "angles_rad": [[0.1, -0.2], [0.3, 0.05]],
        "wavelengths_um": [0.83, 0.87],
        "weights": [0.3, 0.7],
        "centres_um": [[12.0, -24.0], [37.0, 6.0]],
        "energy_um2": [[7.0, 8.0, 9.0], [10.0, 11.0, 12.0]],
        "shape": [2, 3, 4, 5],
        "axes": "angle depth y x",
        "length_unit": "um",
        "angle_unit": "rad",
    }
    assert about == want


def test_the_head_of_a_matlab_file_is_116_bytes_of_text_and_its_version():
    data = export.write_matlab(stack())
    assert (
        data[:116].decode()
        == f"{'MATLAB 5.0 MAT-file, metalens PSF stack, um and rad':116}"
    )
    assert struct.unpack("<H", data[124:126])[0] == 0x0100
    read = loadmat(io.BytesIO(data))
    assert np.array_equal(read["intensity"], LIGHT)
    assert read["depths_um"].shape == (3, 1)
    assert read["energy_um2"].tolist() == [[7.0, 8.0, 9.0], [10.0, 11.0, 12.0]]
    numbers = {
        name: read[name].item()
        for name in ("step_um", "sensor_distance_um", "tolerance", "error", "reason")
    }
    assert list(numbers.values()) == [0.8, 123.0, 2e-4, 3e-5, "by hand"]


def test_fits_axes_count_from_the_middle_of_an_oblong_window():
    """Of five columns the third, of four rows between the second and the third, where
    pixels count from 1.
    """
    (about, image), *parts = list(_units(export.write_fits(stack())))
    assert np.array_equal(image, LIGHT)
    assert [about[f"CTYPE{axis}"] for axis in (1, 2)] == ["x", "y"]
    assert [about[f"CUNIT{axis}"] for axis in (1, 2)] == ["um", "um"]
    assert [float(about[f"CRPIX{axis}"]) for axis in (1, 2)] == [3.0, 2.5]
    assert [float(about[f"CRVAL{axis}"]) for axis in (1, 2)] == [0.0, 0.0]
    assert [float(about[f"CDELT{axis}"]) for axis in (1, 2)] == [0.8, 0.8]
    assert [float(about[name]) for name in ("RELERR", "TOLERANC", "SENSDIST")] == [
        3e-5,
        2e-4,
        123.0,
    ]
    named = {cards["EXTNAME"]: values.tolist() for cards, values in parts}
    assert named == {
        "DEPTHS_UM": [np.inf, 900.0, 1300.0],
        "ANGLES_RAD": [[0.1, -0.2], [0.3, 0.05]],
        "WAVELENGTHS_UM": [0.83, 0.87],
        "WEIGHTS": [0.3, 0.7],
        "CENTRES_UM": [[12.0, -24.0], [37.0, 6.0]],
        "ENERGY_UM2": [[7.0, 8.0, 9.0], [10.0, 11.0, 12.0]],
    }


def test_the_ending_says_the_format_in_small_letters_or_capitals(tmp_path):
    made = dataclasses.replace(stack(), depths_um=np.array([800.0, 900.0, 1300.0]))
    for name, begins in (
        ("a.TIF", b"II"),
        ("a.tiff", b"II"),
        ("a.Mat", b"MATLAB"),
        ("a.fits", b"SIMPLE"),
    ):
        export.export_psf(tmp_path / name, made)
        assert (tmp_path / name).read_bytes().startswith(begins)
    export.export_psf(tmp_path / "a.H5", made)
    assert (tmp_path / "a.H5").read_bytes().startswith(b"\x89HDF")
