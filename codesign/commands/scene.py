"""SCENE.toml to rendered eyes: a contact sheet, masks and labels."""

import functools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.batches import augmented_frames, widen_motion
from codesign.commands.options.scene import Options
from codesign.evaluate import scene_image
from codesign.eye import (
    CameraRig,
    MotionRanges,
    PinholeCamera,
    RenderedFrames,
    landmarks,
    states_at,
)
from codesign.settings import LEAST, check_ranges
from metalens import lens as lenses
from metalens.commands import picture
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.core.store import Provenance


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """The content of SCENE.toml; every key may be left out.

    frames, seed: how many states, drawn from which seed.
    pixels, pitch_um: of the image grid.
    elevation_deg, distance_mm: of the camera below the eye's forward direction, and its
    distance from the pupil.
    gaze_deg: largest gaze to the side, and up or down. slip_mm: largest slippage along
    the camera's x, y, z.
    scale: spread of the scale ambiguity (depth and labels times 1 +- scale at an
    unchanged image).
    variety: of the looks, as of training's frames: 1 the population as published, bare;
    2 with spectacles, make-up,
        uneven light, shadows and movement as well.
    """

    frames: int = 24
    seed: int = 0
    pixels: int = 320
    pitch_um: float = 4.5
    elevation_deg: float = 45.0
    distance_mm: float = 21.0
    gaze_deg: tuple[float, float] = (18.0, 13.0)
    slip_mm: tuple[float, float, float] = (2.0, 1.5, 3.5)
    scale: float = 0.0
    variety: float = 1.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            frames=(1, 100_000),
            pixels=(8, 8192),
            pitch_um=(LEAST, 1e4),
            elevation_deg=(-89, 89),
            distance_mm=(LEAST, 1e4),
            gaze_deg=(0, 89),
            slip_mm=(0, 1e4),
            scale=(0, 0.49),
            variety=(0, 4),
        )

    @property
    def rig(self) -> CameraRig:
        """Camera and lamps in um and rad."""
        return replace(
            CameraRig(),
            elevation_rad=math.radians(self.elevation_deg),
            distance_um=self.distance_mm * 1e3,
        )

    @property
    def motion(self) -> MotionRanges:
        """Ranges in um and rad."""
        x, y = (math.radians(angle) for angle in self.gaze_deg)
        x_mm, y_mm, z_mm = self.slip_mm
        slip = (x_mm * 1e3, y_mm * 1e3, z_mm * 1e3)
        return replace(
            widen_motion(self.variety),
            gaze_x_rad=x,
            gaze_y_rad=y,
            slip_um=slip,
            scale=self.scale,
        )


def run(options: Options) -> int:
    """Render, write and show; exit 1 where the image's error is above what it aims at.

    Args:
        options: of the command line.
    """
    if options.image or options.depth_mm or options.width_mm:
        lens_files = [file for file in (options.config, options.lens) if file]
        one = lens_files[0] if len(lens_files) == 1 else None
        return picture.run(options, one, options.output)
    settings = (
        config.load(options.config, SceneSettings)
        if options.config
        else SceneSettings()
    )
    if options.fwhm_nm < 0 or (options.fwhm_nm and options.lens is None):
        raise ConfigError(
            f"--fwhm-nm {options.fwhm_nm:g}: need 0 or more, and --lens, whose light it is"
        )
    lens = lenses.load(options.lens) if options.lens else None
    folder, failures = options.output, list[str]()
    with options.claim_folder(folder) as draft:
        _render_and_write(settings, draft.path)
        values: dict[str, object] = {"frames": settings.frames, "folder": str(folder)}
        summary = f"{settings.frames} frames: {folder}/sheet.png"
        if lens is not None and options.lens is not None:
            options.console.say(
                "the lens over its field; half a minute for one of 1 mm"
            )
            provenance = Provenance(
                config.dumps(settings),
                {options.lens.name: store.sha256(options.lens)},
                settings.seed,
            )
            images = scene_image.image_first_frames(
                lens,
                PinholeCamera(settings.pixels, settings.pitch_um),
                settings.rig,
                functools.partial(
                    _rendered, settings, min(settings.frames, scene_image.FRAMES)
                ),
                fwhm_nm=options.fwhm_nm,
            )
            scene_image.write_images(draft.path, images, provenance)
            values |= {"image_error": images.error, "light": images.light}
            failures.append(images.problem)
            summary += f"\n{images.error:.2g} of a texture is the error of the image: {folder}/image.png{images.light}"
    return options.console.judged(values, summary, failures)


def _rendered(
    settings: SceneSettings, count: int, camera: PinholeCamera, rig: CameraRig
) -> RenderedFrames:
    """The first frames of the settings before a camera."""
    states = states_at(torch.arange(count), settings.seed, motion=settings.motion)
    return augmented_frames(states, rig, camera, settings.variety, (settings.seed, 3))


def _render_and_write(settings: SceneSettings, folder: Path) -> None:
    """Render frames, write scene.h5 (kind ``scene``), labels and sheet.

    Accuracy: light and coverage to 1/510 (8 bits), depth to 1 um (16 bits, up to 65
    mm).
    """
    camera = PinholeCamera(settings.pixels, settings.pitch_um)
    rendered = _rendered(settings, settings.frames, camera, settings.rig)
    f, labels = rendered.frames, rendered.labels
    arrays: dict[str, Array] = {
        "radiance": _bytes(f.radiance),
        "coverage": _bytes(f.coverage[:, 1]),
        "depth_um": f.depth_um.clamp(0, 65535).round().numpy().astype(np.uint16),
        "pupil": _bytes(rendered.pupil),
    }
    for name in type(labels).__slots__:
        arrays[f"labels/{name}"] = getattr(labels, name).numpy()
    provenance = Provenance(config=config.dumps(settings), seed=settings.seed)
    store.save(folder / "scene.h5", "scene", arrays, provenance=provenance)
    store.write_text(folder / "labels.csv", _labels_csv(rendered))
    contact_sheet(rendered, folder / "sheet.png")


def _labels_csv(rendered: RenderedFrames) -> str:
    """Labels as comma-separated values, a frame a line."""
    labels = rendered.labels
    vectors = (("slip", " um"), ("optic", ""), ("visual", ""), ("pupil", " um"))
    head = [f"{name} {axis}{unit}" for name, unit in vectors for axis in "xyz"]
    head += ["pupil x px", "pupil y px", "visible"]
    head += [f"{name} {axis} px" for name in landmarks.NAMES for axis in "xy"]
    columns = (
        labels.slip_um, labels.optic_axis, labels.visual_axis, labels.pupil_um,
        labels.pupil_px, labels.visible[:, None], labels.landmarks_px.flatten(1),
    )  # fmt: skip
    rows = torch.cat(columns, 1).tolist()
    lines = [",".join(head), *(",".join(f"{v:.6g}" for v in row) for row in rows)]
    return "\n".join(lines) + "\n"


def contact_sheet(rendered: RenderedFrames, path: Path) -> None:
    """Write a PNG of up to 24 frames in rows, then depth (near is bright) and pupil
    masks of the first row.

    Args:
        rendered: rendered frames. path: of the file.
    """
    import cv2

    columns = 6

    light = rendered.pinhole()[:24].clamp(0, 1) ** (1 / 1.8)
    depth = (rendered.frames.depth_um * rendered.frames.coverage).sum(1)[:columns]
    nearness = (depth.max() - depth) / (depth.max() - depth.min()).clamp_min(1e-9)
    size = light.shape[-1]
    rows = []
    for pictures in (light, nearness, rendered.pupil[:columns]):
        blank = torch.zeros(-len(pictures) % columns, size, size)
        tiles = torch.cat([pictures, blank]).reshape(-1, columns, size, size)
        rows.append(tiles.transpose(1, 2).reshape(-1, columns * size))
    sheet = (255 * torch.cat(rows)).numpy().astype(np.uint8)
    store.write_bytes(path, cv2.imencode(".png", sheet)[1].tobytes())


def _bytes(values: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return (values.clamp(0, 1) * 255 + 0.5).numpy().astype(np.uint8)
