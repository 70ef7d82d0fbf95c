"""Rendered frames through a lens onto its sensor: scene, image, and the PSFs over field
and depth that made it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from codesign.eye import CameraRig, PinholeCamera, RenderedFrames
from metalens.core import report, store
from metalens.core.arrays import Array
from metalens.core.errors import SceneError
from metalens.core.store import Provenance
from metalens.image import Grid, Imager, imager
from metalens.lens import Lens
from metalens.psf import Source, spectrum

FRAMES = 6  # that are imaged
# of the scene around a frame that is blurred into it: half a window of the PSFs
BLUR_UM = 144.0
TOLERANCE = 0.03  # of the image, relative L2 of a texture
NODES = 3  # PSFs that are kept along x, y and depth: first, middle, last


@dataclass(frozen=True, eq=False, slots=True)
class ImagedFrames:
    """Frames and their images.

    scene, image: (frames, y, x), the image scaled to the light of the scenes. psf:
    (depth, row, column, y, x) of sum
    1, at depth_um, and at the field angles y_deg and x_deg of the rows and columns; the
    outermost are those of the
    samples around the frame that are blurred into it. parts: of the error by cause.
    light: words for what of it the
    pillars are not known for; problem: why the error is above :data:`TOLERANCE`. Empty
    where there are none.
    """

    scene: Array
    image: Array
    psf: Array
    depth_um: Array
    y_deg: Array
    x_deg: Array
    pitch_um: float
    error: float
    parts: dict[str, float]
    light: str = ""
    problem: str = ""


def margin_of(pitch_um: float) -> int:
    """Samples around a frame that are blurred into it.

    Args:
        pitch_um: of the pixels.
    """
    return math.ceil(BLUR_UM / pitch_um)


def lens_imager(
    lens: Lens,
    camera: PinholeCamera,
    depths_um: tuple[float, float],
    *,
    fwhm_nm: float = 0.0,
    tolerance: float = TOLERANCE,
) -> Imager:
    """The true image of a lens file on the samples of a camera, for frames with a
    margin (:func:`margin_of`) that hold
    these depths.

    Args:
        depths_um: nearest and farthest depth of the scenes.
        fwhm_nm: spectral width of the light; 0 for one wavelength.
        tolerance: relative L2 error allowed.

    Raises:
        SceneError: see :func:`metalens.image.imager`.
    """
    margin = margin_of(camera.pitch_um)
    grid = Grid(
        (camera.pixels, camera.pixels),
        camera.pitch_um,
        depths_um,
        margin,
        2 * margin + 1,
    )
    return imager(lens, grid, spectrum=diode_source(lens, fwhm_nm), tolerance=tolerance)


def diode_source(lens: Lens, fwhm_nm: float) -> Source | None:
    """A diode about the design wavelength; None for one wavelength, a width of 0.

    Args:
        lens: to image with. fwhm_nm: spectral width of the light; 0 for one wavelength.
    """
    return Source(lens.wavelength_um * 1e3, fwhm_nm) if fwhm_nm else None


@torch.no_grad()
def image_first_frames(
    lens: Lens,
    camera: PinholeCamera,
    rig: CameraRig,
    rendered: Callable[[PinholeCamera, CameraRig], RenderedFrames],
    *,
    fwhm_nm: float = 0.0,
) -> ImagedFrames:
    """Image the first frames.

    Args:
        camera: samples of the sensor. rendered: gives the frames of a camera and a rig,
            whose pinhole is as far from
            its sensor as this lens through its films
            (:attr:`metalens.lens.Lens.reduced_um`). fwhm_nm: width of the
            light; 0 for one wavelength.

    Raises:
        SceneError: a frame that reaches so far aside that part of the face lies behind
            the lens; a lens that cannot be
            imaged over this field to 3 %, see :func:`metalens.image.imager`.
    """
    margin = margin_of(camera.pitch_um)
    wide = PinholeCamera(camera.pixels + 2 * margin, camera.pitch_um)
    made = rendered(wide, replace(rig, sensor_distance_um=lens.reduced_um))
    seen = made.frames.depth_um[made.frames.coverage > 0]
    if float(seen.min()) <= 0:
        half_um = wide.pixels * wide.pitch_um / 2
        raise SceneError(
            f"a frame of {camera.pixels} samples of {camera.pitch_um:g} um with {BLUR_UM:g} um about it reaches to "
            f"{math.degrees(math.atan(half_um / lens.reduced_um)):.0f} degrees through a lens {lens.reduced_um:.4g} um "
            "before its sensor, where part of the face lies behind it: take fewer or smaller samples, or a lens "
            "farther from its sensor"
        )
    reach = 0.98 * float(seen.min()), 1.02 * float(seen.max())
    optics = lens_imager(lens, camera, reach, fwhm_nm=fwhm_nm)
    inside = slice(margin, margin + camera.pixels)
    plain = made.pinhole()[:, inside, inside]
    light = optics(made.frames)
    if not float(light.sum()) > 0:
        raise SceneError("no light of these frames reaches the sensor")
    rows, columns, depths = (
        np.linspace(0, n - 1, NODES).round().astype(int) for n in optics.stack.shape[:3]
    )
    psf = optics.stack[np.ix_(rows, columns, depths)].permute(2, 0, 1, 3, 4)
    y_um = optics.plan.y_um.numpy()[rows]
    x_um = optics.plan.x_um.numpy()[columns]
    return ImagedFrames(
        plain.numpy().astype(np.float32),
        (light * (plain.sum() / light.sum())).numpy().astype(np.float32),
        psf.numpy().astype(np.float32),
        optics.plan.depths_um.numpy()[depths],
        np.degrees(np.arctan(y_um / lens.reduced_um)),
        np.degrees(np.arctan(x_um / lens.reduced_um)),
        camera.pitch_um,
        optics.error,
        {name: float(value) for name, value in optics.parts.items()},
        spectrum.outside_library_text(
            diode_source(lens, fwhm_nm), lens.proxy.wavelengths_um
        ),
        optics.above(TOLERANCE),
    )


def write_images(folder: Path, found: ImagedFrames, about: Provenance) -> None:
    """image.h5 (kind ``image``) and image.png.

    Args:
        folder: of the files. found: frames with their images. about: of the file.
    """
    names = ("scene", "image", "psf", "depth_um", "y_deg", "x_deg")
    arrays = {name: np.asarray(getattr(found, name)) for name in names}
    said = {"pitch_um": found.pitch_um, "error": found.error} | {
        f"error_{k}": v for k, v in found.parts.items()
    }
    store.save(folder / "image.h5", "image", arrays, attributes=said, provenance=about)
    store.write_bytes(folder / "image.png", plot_image(found))


def plot_image(found: ImagedFrames) -> bytes:
    """The first frame: scene, image, and what the lens took away and added.

    Args:
        found: frames with their images.
    """
    figure, axes = report.make_figure(1, 3, size=(9.6, 3.3))
    apart = found.image[0] - found.scene[0]
    top, most = float(found.scene[0].max()), float(np.abs(apart).max())
    half = found.pitch_um * len(apart) / 2000
    shown = {"extent": (-half, half, half, -half)}
    axes[0].imshow(found.scene[0], cmap="gray", vmin=0, vmax=top, **shown)
    axes[1].imshow(found.image[0], cmap="gray", vmin=0, vmax=top, **shown)
    last = axes[2].imshow(apart, cmap="RdBu_r", vmin=-most, vmax=most, **shown)
    for one, title in zip(axes, ("scene", "image", "image − scene"), strict=True):
        one.set(title=title, xlabel="x on the sensor / mm")
        one.grid(visible=False)
    figure.colorbar(last, ax=axes[2], label="light, as of the scene")
    return report.figure_png(figure)
