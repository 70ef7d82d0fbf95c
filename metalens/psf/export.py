"""PSF stacks for other programs: HDF5 (the project's own file), TIFF pages, MATLAB
arrays, FITS images.
"""

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.store import write_bytes
from metalens.psf.record import AXES, NUMBERS, PsfStack, save

SUFFIXES = (".h5", ".tif", ".tiff", ".mat", ".fits")


def check_psf_format(path: str | Path) -> None:
    """Refuse a file name that says no known format.

    Args:
        path: file to read or write.

    Raises:
        PropagationError: naming the formats there are.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise PropagationError(
            f"{path}: cannot write this format; name it {', '.join(SUFFIXES)}"
        )


def export_psf(path: str | Path, stack: PsfStack) -> None:
    """Write a stack in the format that the name's ending says; same stack, same bytes.

    ``.h5``: everything, read back by :func:`metalens.psf.load`. ``.tif``: a float32
    page for every PSF, the last axis
    before (y, x) running fastest, each of sum 1, with axes, energies and units as JSON
    in the image description
    (a depth at infinity is null there).
    ``.mat``: MATLAB 5 variables of the same names and shapes as in the HDF5 file.
    ``.fits``: the primary image (…, y, x) in float32 with linear x and y axes in um,
    row 0 first (+y down, which most
    viewers draw from below), and an image extension of float64 for every axis and for
    the energies.

    Args:
        path: file to read or write.

    Raises:
        PropagationError: another ending.
    """
    check_psf_format(path)
    suffix = Path(path).suffix.lower()
    if suffix == ".h5":
        save(path, stack)
    else:
        write_bytes(
            path,
            {".mat": write_matlab, ".fits": write_fits}.get(suffix, write_tiff)(stack),
        )


def write_tiff(stack: PsfStack) -> bytes:
    """TIFF file of all PSFs.

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    import tifffile

    plain = stack.numpy()
    about = {name: getattr(plain, name) for name in NUMBERS} | {
        n: v.tolist() for n, v in _arrays(plain).items()
    }
    about["depths_um"] = [
        None if math.isinf(depth) else depth for depth in about["depths_um"]
    ]
    about |= {
        "shape": list(plain.intensity.shape),
        "axes": _axes(plain),
        "length_unit": "um",
        "angle_unit": "rad",
    }
    pages = np.asarray(plain.intensity, np.float32).reshape(
        -1, *plain.intensity.shape[-2:]
    )
    file = io.BytesIO()
    per_cm = (1e4 / plain.step_um, 1e4 / plain.step_um)
    tifffile.imwrite(
        file,
        pages,
        photometric="minisblack",
        metadata=None,
        software="metalens",
        description=json.dumps(about, sort_keys=True),
        resolution=per_cm,
        resolutionunit="CENTIMETER",
    )
    return file.getvalue()


def write_matlab(stack: PsfStack) -> bytes:
    """MATLAB 5 file; the header holds no date.

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    from scipy.io import savemat

    plain = stack.numpy()
    values: dict[str, Any] = {name: getattr(plain, name) for name in NUMBERS} | _arrays(
        plain
    )
    values |= {"intensity": np.asarray(plain.intensity), "axes": _axes(plain)}
    file = io.BytesIO()
    savemat(file, values, oned_as="column")
    return (
        b"MATLAB 5.0 MAT-file, metalens PSF stack, um and rad".ljust(116)
        + file.getvalue()[116:]
    )


def write_fits(stack: PsfStack) -> bytes:
    """FITS file of all PSFs; needs astropy (extra ``fits``).

    Args:
        stack: PSFs over angle, depth and wavelength.
    """
    from astropy.io import fits as library

    plain = stack.numpy()
    image = library.PrimaryHDU(np.asarray(plain.intensity, np.float32))
    head = image.header
    for axis, pixels in (
        (1, plain.intensity.shape[-1]),
        (2, plain.intensity.shape[-2]),
    ):
        head[f"CTYPE{axis}"], head[f"CUNIT{axis}"] = " xy"[axis], "um"
        head[f"CRPIX{axis}"], head[f"CRVAL{axis}"], head[f"CDELT{axis}"] = (
            (pixels + 1) / 2,
            0.0,
            plain.step_um,
        )
    head["AXES"] = (_axes(plain), "of the image, slowest first")
    head["RELERR"] = (plain.error, "relative L2 error of the PSFs")
    head["TOLERANC"] = (plain.tolerance, "relative L2 error that was asked for")
    head["SENSDIST"] = (plain.sensor_distance_um, "um from the lens to the sensor")
    head["CREATOR"] = "metalens"
    parts = [
        library.ImageHDU(values, name=name.upper())
        for name, values in _arrays(plain).items()
    ]
    file = io.BytesIO()
    library.HDUList([image, *parts]).writeto(file, checksum=False)
    return file.getvalue()


def _arrays(plain: PsfStack) -> dict[str, Array]:
    """Axes and energies by name."""
    return {name: np.asarray(getattr(plain, name)) for name in (*AXES, "energy_um2")}


def _axes(plain: PsfStack) -> str:
    """Names of the axes of the intensity, slowest first."""
    extra = plain.intensity.ndim - 3
    angle = extra > 0 and plain.intensity.shape[extra - 1] == len(plain.angles_rad)
    return " ".join(
        [*["lens"] * (extra - angle), *["angle"] * angle, "depth", "y", "x"]
    )
