"""PSF stacks as TIFF, MATLAB and FITS files: read back by other readers, equal to what
was written.
"""

import io
import json

import numpy as np
import pytest
import tifffile
from scipy.io import loadmat

from metalens import psf
from metalens.core.errors import PropagationError
from metalens.psf import export as psf_export


@pytest.fixture(scope="module")
def stack():
    n = 32
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    phase = -2 * np.pi / 0.85 * (x**2 + (x[:, None] - 1.0) ** 2) / 240
    return psf.psf_stack(
        phase,
        np.ones((n, n)),
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=120.0,
        depths_um=[1000.0, 1600.0, 2500.0],
        angle_rad=[[0.0, 0.0], [0.1, -0.05]],
        window_um=12.0,
        samples=10,
    )


def test_tiff_pages_are_the_psfs_and_the_description_says_which(stack):
    with tifffile.TiffFile(io.BytesIO(psf_export.write_tiff(stack))) as file:
        pages = file.asarray()
        about = json.loads(file.pages[0].description)
    assert pages.dtype == np.float32
    assert about["axes"] == "angle depth y x"
    assert np.array_equal(pages.reshape(about["shape"]), stack.intensity.astype("f4"))
    assert about["depths_um"] == [1000.0, 1600.0, 2500.0]
    assert np.allclose(about["angles_rad"], stack.angles_rad, atol=1e-15)
    assert np.array_equal(about["energy_um2"], stack.energy_um2)


def test_matlab_variables_have_the_names_of_the_record(stack):
    read = loadmat(io.BytesIO(psf_export.write_matlab(stack)))
    assert np.array_equal(read["intensity"], stack.intensity)
    assert np.array_equal(read["depths_um"].ravel(), stack.depths_um)
    assert read["step_um"].item() == stack.step_um
    assert read["axes"].item() == "angle depth y x"


def _units(data):
    """Headers and bytes of a FITS file by the standard alone: 2880-byte blocks, 80-byte
    cards, big-endian values.
    """
    while data:
        cards = {}
        while "END" not in cards:
            block, data = data[:2880], data[2880:]
            for card in (block[i : i + 80].decode("ascii") for i in range(0, 2880, 80)):
                cards[card[:8].strip()] = (
                    card[10:].split("/")[0].strip().strip("'").strip()
                )
        shape = [
            int(cards[f"NAXIS{axis}"]) for axis in range(int(cards["NAXIS"]), 0, -1)
        ]
        kind = {"-32": ">f4", "-64": ">f8"}[cards["BITPIX"]]
        size = int(np.prod(shape)) * int(kind[2])
        yield cards, np.frombuffer(data[:size], kind).reshape(shape)
        data = data[-(-size // 2880) * 2880 :]


def test_fits_images_have_axes_in_um_and_the_energies_beside_them(stack):
    (about, image), *parts = list(_units(psf_export.write_fits(stack)))
    assert np.array_equal(image, stack.intensity.astype("f4"))
    assert about["AXES"] == "angle depth y x"
    assert (about["CTYPE1"], about["CUNIT2"], float(about["CDELT1"])) == (
        "x",
        "um",
        pytest.approx(12 / 10, rel=1e-12),
    )
    # pixels count from 1: the middle of ten lies between the fifth and the sixth
    assert float(about["CRPIX1"]) == 5.5
    assert float(about["SENSDIST"]) == 120.0
    named = {cards["EXTNAME"]: values for cards, values in parts}
    assert np.array_equal(named["DEPTHS_UM"], [1000.0, 1600.0, 2500.0])
    assert np.array_equal(named["ENERGY_UM2"], stack.energy_um2)
    assert np.array_equal(named["ANGLES_RAD"], stack.angles_rad)


@pytest.mark.parametrize("name", ["psf.h5", "psf.tif", "psf.mat", "psf.fits"])
def test_same_stack_same_bytes(stack, tmp_path, name):
    written = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        psf_export.export_psf(tmp_path / folder / name, stack)
        written.append((tmp_path / folder / name).read_bytes())
    assert written[0] == written[1]


def test_other_endings_are_refused(stack, tmp_path):
    with pytest.raises(PropagationError, match=r"\.tif"):
        psf_export.export_psf(tmp_path / "psf.png", stack)
