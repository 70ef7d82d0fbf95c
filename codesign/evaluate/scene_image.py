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
from metalens.image import Grid, imager
from metalens.lens import Lens
from metalens.psf import Source, spectrum

FRAMES = 6  # frames that are imaged
BLUR_UM = 144.0  # width of the scene around a frame: half a window of the PSFs
TOLERANCE = 0.03  # relative L2 error of the image of a texture
NODES = 3  # stored PSFs along x, y and depth: first, middle, last


@dataclass(frozen=True, eq=False, slots=True)
class ImagedFrames:
    """Rendered frames, their images and the PSFs.

    scene, image: (frames, y, x); the image is scaled to the light of the scenes.
    psf: (depth, row, column, y, x) PSFs of sum 1.
    depth_um: (depth,). y_deg, x_deg: field angles of the PSFs' rows and columns, the
    outermost at the edge of the margin.
    pitch_um: pitch of the samples.
    error: relative L2 error of the image.
    light: wavelengths that the pillar model does not cover, in words, or empty.
    problem: why the error exceeds :data:`TOLERANCE`, or empty.
    """

    scene: Array
    image: Array
    psf: Array
    depth_um: Array
    y_deg: Array
    x_deg: Array
    pitch_um: float
    error: float
    light: str = ""
    problem: str = ""


def margin_of(pitch_um: float) -> int:
    """Samples around a frame that are blurred into it: ceil(BLUR_UM / pitch).

    Args:
        pitch_um: pitch of the samples.
    """
    return math.ceil(BLUR_UM / pitch_um)


@torch.no_grad()
def image_first_frames(
    lens: Lens,
    camera: PinholeCamera,
    rig: CameraRig,
    rendered: Callable[[PinholeCamera, CameraRig], RenderedFrames],
    *,
    fwhm_nm: float = 0.0,
) -> ImagedFrames:
    """Render frames and image them through a lens, with the PSFs at the corners, edges
    and middle of field and depth.

    Args:
        lens: lens to image through.
        camera: samples of the sensor.
        rig: camera pose; its sensor distance becomes the lens's reduced one.
        rendered: renders the frames of a camera and a rig.
        fwhm_nm: spectral width of the light; 0 for one wavelength.

    Raises:
        SceneError: a field so wide that part of the face lies behind the lens; a lens
            that cannot be imaged to 3 %, see :func:`metalens.image.imager`.
    """
    margin = margin_of(camera.pitch_um)
    wide_camera = PinholeCamera(camera.pixels + 2 * margin, camera.pitch_um)
    renderings = rendered(wide_camera, replace(rig, sensor_distance_um=lens.reduced_um))
    visible_um = renderings.frames.depth_um[renderings.frames.coverage > 0]
    if float(visible_um.min()) <= 0:
        half_um = wide_camera.pixels * wide_camera.pitch_um / 2
        raise SceneError(
            f"a frame of {camera.pixels} samples of {camera.pitch_um:g} um with {BLUR_UM:g} um about it reaches to "
            f"{math.degrees(math.atan(half_um / lens.reduced_um)):.0f} degrees through a lens {lens.reduced_um:.4g} um "
            "before its sensor, where part of the face lies behind it: take fewer or smaller samples, or a lens "
            "farther from its sensor"
        )
    depths_um = 0.98 * float(visible_um.min()), 1.02 * float(visible_um.max())
    shape = (camera.pixels, camera.pixels)
    grid = Grid(shape, camera.pitch_um, depths_um, margin, 2 * margin + 1)
    source = Source(lens.wavelength_um * 1e3, fwhm_nm) if fwhm_nm else None
    optics = imager(lens, grid, spectrum=source, tolerance=TOLERANCE)
    inner = slice(margin, margin + camera.pixels)
    scene = renderings.pinhole()[:, inner, inner]
    light = optics(renderings.frames)
    if not float(light.sum()) > 0:
        raise SceneError("no light of these frames reaches the sensor")
    rows, columns, depths = (
        np.linspace(0, n - 1, NODES).round().astype(int) for n in optics.stack.shape[:3]
    )
    psf = optics.stack[np.ix_(rows, columns, depths)].permute(2, 0, 1, 3, 4)
    y_deg, x_deg = (
        np.degrees(np.arctan(place_um.numpy()[nodes] / lens.reduced_um))
        for place_um, nodes in ((optics.plan.y_um, rows), (optics.plan.x_um, columns))
    )
    return ImagedFrames(
        scene.numpy().astype(np.float32),
        (light * (scene.sum() / light.sum())).numpy().astype(np.float32),
        psf.numpy().astype(np.float32),
        optics.plan.depths_um.numpy()[depths],
        y_deg,
        x_deg,
        camera.pitch_um,
        optics.error,
        spectrum.outside_library_text(source, lens.proxy.wavelengths_um),
        optics.above(TOLERANCE),
    )


def write_images(folder: Path, imaged: ImagedFrames, about: Provenance) -> None:
    """Write image.h5 (kind ``image``) and image.png.

    Args:
        folder: folder to write to.
        imaged: frames with their images.
        about: provenance of image.h5.
    """
    names = ("scene", "image", "psf", "depth_um", "y_deg", "x_deg")
    arrays = {name: np.asarray(getattr(imaged, name)) for name in names}
    attributes = {"pitch_um": imaged.pitch_um, "error": imaged.error}
    store.save(
        folder / "image.h5", "image", arrays, attributes=attributes, provenance=about
    )
    store.write_bytes(folder / "image.png", plot_image(imaged))


def plot_image(imaged: ImagedFrames) -> bytes:
    """PNG of the first frame: scene, image, and image minus scene.

    Args:
        imaged: frames with their images.
    """
    figure, axes = report.make_figure(1, 3, size=(9.6, 3.3))
    scene, image = imaged.scene[0], imaged.image[0]
    half_mm = imaged.pitch_um * len(scene) / 2000
    largest = float(np.abs(image - scene).max())
    grey = {"cmap": "gray", "vmin": 0, "vmax": float(scene.max())}
    signed = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
    for panel, title, picture, colours in (
        (axes[0], "scene", scene, grey),
        (axes[1], "image", image, grey),
        (axes[2], "image − scene", image - scene, signed),
    ):
        drawn = panel.imshow(
            picture, extent=(-half_mm, half_mm, half_mm, -half_mm), **colours
        )
        panel.set(title=title, xlabel="x on the sensor / mm")
        panel.grid(visible=False)
    figure.colorbar(drawn, ax=axes[2], label="light, as of the scene")
    return report.figure_png(figure)
