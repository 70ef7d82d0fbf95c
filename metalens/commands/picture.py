"""``metalens scene --image``: a picture at a distance, as a lens images it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from metalens import design
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.store import Provenance
from metalens.lens import Lens, load, reach
from metalens.psf import Source, spectrum

LARGEST_WINDOW = 513  # samples along the window of a PSF


@dataclass(frozen=True, slots=True)
class PicturePlane:
    """A picture on a plane in front of a lens.

    depth_mm: distance from the lens, inf for what is far away.
    width_mm: of the picture; 0 for the lens's field of view, over which a hyperbolic
        lens of its focus is diffraction-limited.
    fwhm_nm: spectral width of the light; 0 for one wavelength.
    tolerance: relative L2 error of the image of a texture.
    """

    depth_mm: float
    width_mm: float
    fwhm_nm: float
    tolerance: float

    def __post_init__(self) -> None:
        far = math.isinf(self.depth_mm) and self.width_mm
        if not self.depth_mm > 0 or self.width_mm < 0 or self.fwhm_nm < 0 or far:
            raise ConfigError(
                f"--image: depth {self.depth_mm:g} mm, width {self.width_mm:g} mm, "
                f"{self.fwhm_nm:g} nm of light: need a depth above 0 (--depth-mm), and "
                "a width and a bandwidth of 0 or more; at infinity no width"
            )


def image_picture(
    lens_file: Path, picture: Path, plane: PicturePlane, folder: Path
) -> tuple[dict[str, Any], str, str]:
    """Image a picture and write image.h5 (kind ``image``) and sensor.png (16 bits).

    The picture is the radiance of the plane; each colour is imaged in the lens's light.
    Beyond its borders it goes on as at them. The image is irradiance, 1 on the axis of
    an even plane of radiance 1 of which all light lands in the PSF's window.

    Args:
        lens_file: of the lens.
        picture: grey or colour, 8 or 16 bits, or floating point.
        plane: where the picture stands.
        folder: written to.

    Returns:
        (values, summary, problem): of the command; the problem is empty within the
        tolerance.

    Raises:
        ConfigError: no picture, or samples too fine for the blur of the lens.
    """
    import cv2
    import torch

    from metalens.image import Grid, imager

    device = load(lens_file)
    scene = read_colours(picture)
    rows, columns = scene.shape[1:]
    depth_um = plane.depth_mm * 1e3
    step_um = 2 * _half_width_um(device, plane) / columns
    window_um = reach.window_um(device, (depth_um,), airy=28.0)
    window = max(math.ceil(window_um / step_um), 3) | 1
    if window > LARGEST_WINDOW:
        raise ConfigError(
            f"{picture}: {columns} samples of {step_um:.3g} um on the sensor, where a "
            f"point is {window_um:g} um wide: take fewer samples or a wider picture"
        )
    grid = Grid((rows, columns), step_um, (depth_um, depth_um), 0, window)
    source = (
        Source(device.wavelength_um * 1e3, plane.fwhm_nm) if plane.fwhm_nm else None
    )
    optics = imager(device, grid, spectrum=source, tolerance=plane.tolerance)
    with torch.no_grad():
        light = torch.from_numpy(scene)
        image = optics.surface(light, torch.full_like(light, depth_um)).numpy()
    tangents = optics.plan.places_um.numpy() / device.reduced_um
    cosine4 = (1 + (tangents**2).sum(1)) ** -2
    outside = 1 - float((optics.energy.flatten().numpy() / cosine4).mean())
    level = np.clip(image / max(image.max(), 1e-30), 0, 1)
    pixels = np.moveaxis((65535 * level + 0.5).astype(np.uint16), 0, -1)[..., ::-1]
    store.write_bytes(folder / "sensor.png", cv2.imencode(".png", pixels)[1].tobytes())
    x_deg, y_deg = (
        np.rad2deg(np.arctan(nodes.numpy() / device.reduced_um))
        for nodes in (optics.plan.x_um, optics.plan.y_um)
    )
    arrays = {
        "scene": scene,
        "image": image,
        "psf": optics.stack.permute(2, 0, 1, 3, 4).numpy(),
        "depth_um": np.array([depth_um]),
        "y_deg": y_deg,
        "x_deg": x_deg,
    }
    values: dict[str, Any] = {
        "image_error": optics.error,
        "outside_window": outside,
        "window_um": window * step_um,
        "pitch_um": step_um,
        "half_field_deg": float(x_deg[-1]),
    }
    files = {file.name: store.sha256(file) for file in (lens_file, picture)}
    store.save(
        folder / "image.h5",
        "image",
        arrays,
        attributes={"pitch_um": step_um, "error": optics.error},
        provenance=Provenance(inputs=files),
    )
    library = device.proxy.wavelengths_um
    summary = (
        f"sensor image within a relative error of {optics.error:.2g} of a texture; "
        f"{outside:.2g} of the light is absorbed, or lands beyond a window of {window * step_um:.3g} um "
        f"about its image point{spectrum.outside_library_text(source, library)}"
    )
    return values, summary, optics.above(plane.tolerance)


def _half_width_um(device: Lens, plane: PicturePlane) -> float:
    """Half width of the picture's image on the sensor, um."""
    if plane.width_mm:
        before = device.layers.before(plane.depth_mm * 1e3, device.wavelength_um)
        return plane.width_mm * 500 / before.reduced_um * device.reduced_um
    radius_um = device.diameters.radius_um + device.diameters.pitch_um / 2
    half_rad = design.field_angle(design.lens_focus(device), radius_um)
    return device.reduced_um * math.tan(half_rad)


def read_colours(picture: Path) -> Array:
    """(colours, y, x) float32 radiance of a picture, 1 for the largest integer.

    Transparency is left out; values are taken as linear.

    Args:
        picture: grey, or of red, green and blue.

    Raises:
        ConfigError: no picture.
    """
    import cv2

    pixels = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ConfigError(f"{picture}: no picture that can be read (PNG, TIFF, JPEG)")
    largest = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    colours = np.atleast_3d(pixels)[..., :3][..., ::-1].astype(np.float32) / largest
    return np.ascontiguousarray(np.moveaxis(colours, -1, 0))
