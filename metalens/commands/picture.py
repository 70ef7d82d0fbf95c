"""``metalens scene --image``: a picture at a distance, as a lens images it."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from metalens import design
from metalens.commands.common import CommonOptions
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.lens import Lens, load, reach
from metalens.psf import Source, spectrum

LARGEST_WINDOW = 513  # samples along the window of a PSF


@dataclass(frozen=True, kw_only=True)
class PictureOptions(CommonOptions):
    """Options of a picture that a lens images.

    Attributes:
        image: a picture (grey or colour, values as radiance) that the lens images, in
            place of eyes.
        depth_mm: distance of the picture from the lens, inf for what is far away.
        width_mm: width of the picture; left out: the lens's field of view, over which a
            hyperbolic lens of its focus is diffraction-limited.
        fwhm_nm: spectral width of the light, 0 for one wavelength.
        tolerance: relative L2 error of the picture's image. Ends 1 above it.
    """

    image: Path | None = None
    depth_mm: float = field(default=0.0, metadata={"may_be_inf": True})
    width_mm: float = 0.0
    fwhm_nm: float = 0.0
    tolerance: float = 0.03


def run(options: PictureOptions, lens_file: Path | None, target: Path) -> int:
    """Image a picture and write image.h5 (kind ``image``) and sensor.png (16 bits).

    The picture is the radiance of the plane; each colour is imaged in the lens's light.
    Beyond its borders it goes on as at them. The image is irradiance, 1 on the axis of
    an even plane of radiance 1 of which all light lands in the PSF's window.

    Args:
        options: of the command line.
        lens_file: of the lens; None where it is not one.
        target: folder to write.

    Returns:
        Exit status: 1 where the error is above the tolerance.

    Raises:
        ConfigError: no picture or lens, or samples too fine for the blur of the lens.
    """
    import cv2
    import torch

    from metalens.image import Grid, imager

    depth_um, width_um = 1e3 * options.depth_mm, 1e3 * options.width_mm
    in_range = depth_um > 0 <= width_um and options.fwhm_nm >= 0
    in_range &= not (width_um and math.isinf(depth_um))
    if options.image is None or lens_file is None or not in_range:
        raise ConfigError(
            "a picture needs --image, one lens (lens.h5), --depth-mm above 0, and "
            "--width-mm (none at infinity) and --fwhm-nm of 0 or more"
        )
    device, scene = load(lens_file), read_colours(options.image)
    step_um = 2 * _half_width_um(device, depth_um, width_um) / scene.shape[2]
    window_um = reach.window_um(device, (depth_um,), airy=28.0)
    window = max(math.ceil(window_um / step_um), 3) | 1
    if window > LARGEST_WINDOW:
        raise ConfigError(
            f"{options.image}: samples of {step_um:.3g} um on the sensor, where a point "
            f"is {window_um:g} um wide: take fewer samples or a wider picture"
        )
    source = None
    if options.fwhm_nm:
        source = Source(device.wavelength_um * 1e3, options.fwhm_nm)
    rows, columns = scene.shape[1:]
    grid = Grid((rows, columns), step_um, (depth_um, depth_um), 0, window)
    with options.claim_folder(target, inputs=[lens_file]) as draft:
        optics = imager(device, grid, spectrum=source, tolerance=options.tolerance)
        with torch.no_grad():
            light = torch.from_numpy(scene)
            image = optics.surface(light, torch.full_like(light, depth_um)).numpy()
        level = np.clip(image / max(image.max(), 1e-30), 0, 1)
        pixels = np.moveaxis((65535 * level + 0.5).astype(np.uint16), 0, -1)
        png = cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()
        store.write_bytes(draft.path / "sensor.png", png)
        tangents = optics.plan.places_um.numpy() / device.reduced_um
        y, x = (nodes.numpy() for nodes in (optics.plan.y_um, optics.plan.x_um))
        arrays = {
            "scene": scene,
            "image": image,
            "psf": optics.stack.permute(2, 0, 1, 3, 4).numpy(),
            "depth_um": np.array([depth_um]),
            "y_deg": np.rad2deg(np.arctan(y / device.reduced_um)),
            "x_deg": np.rad2deg(np.arctan(x / device.reduced_um)),
        }
        files = (lens_file, options.image)
        store.save(
            draft.path / "image.h5",
            "image",
            arrays,
            attributes={"pitch_um": step_um, "error": optics.error},
            provenance=store.Provenance(
                inputs={f.name: store.sha256(f) for f in files}
            ),
        )
    cosine4 = (1 + (tangents**2).sum(1)) ** -2
    outside = 1 - float((optics.energy.flatten().numpy() / cosine4).mean())
    values = {"image_error": optics.error, "outside": outside, "pitch_um": step_um}
    text = (
        f"{target}/sensor.png: within a relative error of {optics.error:.2g} of a "
        f"texture; {outside:.2g} of the light is absorbed, or lands beyond a window of "
        f"{window * step_um:.3g} um about its image point"
        f"{spectrum.outside_library_text(source, device.proxy.wavelengths_um)}"
    )
    return options.console.judged(values, text, [optics.above(options.tolerance)])


def _half_width_um(device: Lens, depth_um: float, width_um: float) -> float:
    """Half width of the picture's image on the sensor, um."""
    if width_um:
        before = device.layers.before(depth_um, device.wavelength_um)
        return width_um / 2 / before.reduced_um * device.reduced_um
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

    pixels = None
    if picture.is_file():
        pixels = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ConfigError(f"{picture}: no picture that can be read (PNG, TIFF, JPEG)")
    largest = np.iinfo(str(pixels.dtype)).max if pixels.dtype.kind == "u" else 1
    colours = np.atleast_3d(pixels)[..., :3][..., ::-1].astype(np.float32) / largest
    return np.ascontiguousarray(np.moveaxis(colours, -1, 0))
