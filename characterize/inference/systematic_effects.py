"""Causes that the fit leaves out, each by what it does to the images, and how large it
may be where nobody says.
"""

import contextlib
import copy
import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from characterize.inference.multistart import SearchTask
from characterize.model import LIGHT, PARAMETERS, PLACE, background_planes, type_b_sigma
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import CDError, ResponseError, names_of_kind
from metalens.lens import Lens

# amounts by which the causes are probed
_STOP_UM = 3.0
_WALL_DEG = 1.5
LAMP = "a lamp or exposure that changes from frame to frame"
WINDOWS = "a window off the chief ray at a field angle"
# share below which a turn of light is the error of its slopes: that light is round
_ROUND = 0.02

_TILTED = {"glass_um": 100.0, "glass_tilt_x_deg": 0.0, "glass_tilt_y_deg": 0.0}
_SQUARE = ("pinhole_um", "bandwidth_nm")  # blur acts as the square of its size
_OF_MASK = {*names_of_kind(CDError), *names_of_kind(ResponseError)}


@dataclass(frozen=True, eq=False, slots=True)
class ImageChange:
    """A cause that is not fitted, and (k, n, y, x) changes of the images by it.

    sigma: standard deviation of the factor of each change, assumed where nobody states
    it; one for all or one for each, 0 for none.
    frees: parameters that describe the cause. stated: whether one of these is stated
    without an error.
    of_mask: the cause belongs to the lens itself. positive: its amount cannot be
    below 0.
    """

    cause: str
    images: Array
    sigma: float | Array = 0.0
    frees: tuple[str, ...] = ()
    stated: bool = False
    of_mask: bool = False
    positive: bool = False


def systematic_changes(
    task: SearchTask, x: Array, slopes: dict[str, Array]
) -> Iterator[ImageChange]:
    """Changes of the images by every systematic effect that is not fitted.

    Args:
        task: model, frames, priors and arrangement of the search.
        x: all parameters, in the order of ``PARAMETERS``.
        slopes: derivatives of the images by the fitted parameters.
    """
    model = task.model
    image = model.images(x)[0]
    yield from _of_model(task, x, image)
    if "sidewall_deg" not in task.names or model.lens.cell.sidewall_rad == 0:
        leaning = model.with_walls(math.radians(_WALL_DEG)).images(x)[0] - image
        yield ImageChange(
            "a side wall that leans about half height",
            leaning[None],
            (_size(task, "sidewall_deg") / _WALL_DEG) ** 2,
            of_mask=True,
            positive=True,
        )
    light = image - background_planes(x, model.setting)
    yield ImageChange("vibration or blur along one direction", _along_one(light))
    yield ImageChange(
        "pixels of 2 x 2 that see unlike shares of the light (a raw colour mosaic)",
        _of_mosaic(light),
    )
    yield ImageChange(
        "counts that are not in proportion to the light (a gamma)", _of_gamma(light)
    )
    # derivatives by the place of every pixel, per pixel
    across = np.asarray(model.images(x, ("decentre_x_um", "decentre_y_um"))[1])
    across *= model.setting.pixel_um
    if len(image) > 2:
        yield from _of_frames(light, slopes, across)
    yield from _of_pixels(task, across)
    yield from _of_stop(task, x, image)
    fixed = tuple(name for name in LIGHT if name not in task.names)
    if fixed:
        frees = tuple(name for name in fixed if not _exactly(task, name))
        yield ImageChange(
            "uneven illumination",
            np.asarray(model.images(x, fixed)[1]),
            np.array([_size(task, name) for name in fixed]),
            frees or fixed,
            not frees,
        )
    phases = functools.partial(write_field_phases, model.lens)
    names = [f"residual_{k}" for k in range(32)]
    yield ImageChange(
        "write fields out of place, or another smooth phase error",
        np.asarray(model.with_residual(phases).images(x, names)[1]),
        _size(task, "stitching_nm") * 1e-3,
        of_mask=True,
    )


def _of_model(task: SearchTask, x: Array, image: Array) -> Iterator[ImageChange]:
    """Changes by parameters of the model that are not fitted, each by its probe amount.

    Tilts of the glass without glass are those of a plate of 100 um.
    """
    for row in (row for row in PARAMETERS if row.effect):
        name, amount = row.name, row.probe
        base: dict[str, float] = {}
        if name.startswith("glass_tilt") and x[PLACE["glass_um"]] == 0:
            if "glass_um" in task.known:
                continue
            base = _TILTED
        if name in task.names:
            continue
        before, after = x.copy(), x.copy()
        for key, value in base.items():
            before[PLACE[key]] = after[PLACE[key]] = value
        after[PLACE[name]] += amount
        # a spectrum beyond the proxy's range, or a plate that does not fit, is skipped
        with contextlib.suppress(FitError):
            first = task.model.images(before)[0] if base else image
            change = task.model.images(after)[0] - first
            yield ImageChange(
                row.effect.format(before[PLACE["glass_um"]]),
                change[None],
                (_size(task, name) / amount) ** (2 if name in _SQUARE else 1),
                ("glass_um", name) if base else (name,),
                _exactly(task, name),
                of_mask=name in _OF_MASK,
                positive=before[PLACE[name]] <= row.low,
            )


def _of_frames(
    light: Array, slopes: dict[str, Array], across: Array
) -> Iterator[ImageChange]:
    """Changes of single frames: brightness, shifts, blur, stage, and wavelength drift.

    Args:
        light: (n, y, x) images without background.
        slopes: derivatives of the images by the fitted parameters.
        across: (2, n, y, x) derivatives by a shift along x and along y.
    """
    yield ImageChange(LAMP, _each(light))
    yield ImageChange(
        "shifts from frame to frame", np.concatenate([*map(_each, across)])
    )
    yield ImageChange("vibration or blur in single frames", _each(_curvature(light)))
    if "stage_zero_um" in slopes:
        yield ImageChange(
            "a stage error in single frames", _each(slopes["stage_zero_um"])
        )
    if "wavelength_nm" in slopes:
        ramp = np.linspace(-1, 1, len(light))[:, None, None]
        yield ImageChange(
            "a wavelength that drifts", (slopes["wavelength_nm"] * ramp)[None]
        )


def _of_pixels(task: SearchTask, across: Array) -> Iterator[ImageChange]:
    """Changes by pixels at other places: turned axes, a larger pitch along y, and
    windows of one field angle that are off along x and y.

    The first angle is left out, as decentre moves all windows.

    Args:
        across: (2, n, y, x) derivatives by a shift of a pixel along x and along y.
    """
    setting = task.model.setting
    by_x, by_y = across
    # (y, x) of the pixels from the window's middle
    y, x = (edge * n / 2 for edge, n in zip(setting.edges, by_x.shape[1:], strict=True))
    turned = np.radians(x * by_y - y * by_x)  # by one degree from +x to +y
    if np.abs(turned).max() > _ROUND * np.radians(np.abs(x * by_y)).max():
        size_deg = _size(task, "camera_turn_deg")
        yield ImageChange("a camera that is turned", turned[None], size_deg)
    yield ImageChange("pixels that are not as high as wide", (y * by_y)[None])
    groups = task.model.groups[1:]
    if groups:
        moved = np.zeros((len(groups), *across.shape))
        for k, group in enumerate(groups):
            moved[k, :, group.index] = across[:, group.index].swapaxes(0, 1)
        changes = moved.reshape(-1, *by_x.shape)
        yield ImageChange(WINDOWS, changes, _size(task, "window_px"))


def _of_stop(task: SearchTask, x: Array, image: Array) -> Iterator[ImageChange]:
    """Changes by an aperture stop off its place, along x and along y.

    The illuminated part of the lens moves, as by a tilt of the lens.
    """
    stop = task.model.lens.layers.stop
    if stop is None:
        return
    model = copy.copy(task.model)
    for along in (0, 1):
        centre = np.add(stop.centre_um, _STOP_UM * np.eye(2)[along])
        moved = dataclasses.replace(
            stop, centre_um=(float(centre[0]), float(centre[1]))
        )
        layers = dataclasses.replace(task.model.lens.layers, stop=moved)
        model.lens = dataclasses.replace(task.model.lens, layers=layers)
        depth_um = model.setting.depth_um
        model.groups = [g.shaded(model.lens, depth_um) for g in task.model.groups]
        yield ImageChange(
            f"an aperture stop off along {'xy'[along]}",
            (model.images(x)[0] - image)[None],
            _size(task, "stop_um") / _STOP_UM,
        )


def _exactly(task: SearchTask, name: str) -> bool:
    """Whether a parameter is stated without an error: it stays as stated, whatever the
    residuals lean to.
    """
    return name in task.known and task.known[name].sigma == 0


def _size(task: SearchTask, name: str) -> float:
    """Standard deviation of a cause: as stated, else a Type B estimate.

    0 where it is fixed as stated.
    """
    if name in task.unfitted:
        return task.unfitted[name]
    stated = task.known.get(name)
    if stated is None:
        return type_b_sigma(name, task.model.lens)
    if name == "sidewall_deg":  # the model has upright walls: the mean counts too
        return math.hypot(stated.sigma, stated.value)
    return stated.sigma


def write_field_phases(lens: Lens, u: Array, v: Array) -> Array:
    """(32, *shape) phases of one write field that is moved by 1 um along x, then along
    y, at places (u, v) on the lens over its radius, rad.

    Four fields across the lens each way. The focusing phase has the slope
    k x (1 / hypot(r, d) + 1 / hypot(r, s)) at place x along the axis, with focal
    distance d and source distance s.
    """
    radius = lens.diameters.radius_um
    r = radius * np.hypot(u, v)
    sine = 1 / np.hypot(r, lens.reduced_um)
    if lens.source_distance_um > 0:
        sine = sine + 1 / np.hypot(r, lens.source_distance_um)
    sine *= 2 * math.pi / lens.wavelength_um * radius
    row, column = (np.clip(np.floor(2 * (w + 1)), 0, 3) for w in (v, u))
    inside = 4 * row + column == np.arange(16).reshape(-1, *(1,) * u.ndim)
    return np.concatenate([inside * sine * u, inside * sine * v])


def _each(change: Array) -> Array:
    """(n, n, y, x): every frame's change alone."""
    out = np.zeros((len(change), *change.shape))
    out[np.arange(len(change)), np.arange(len(change))] = change
    return out


def _along_one(light: Array) -> Array:
    """(2, n, y, x) changes by a directional blur: xx - yy and 2 xy second differences.

    A blur of variance s² wider along x than along y, or along one diagonal than along
    the other, changes the light by s²/2 of these. Round blur has parameters of its
    own.
    """
    xx, yy = (
        ndimage.correlate1d(light, [1.0, -2.0, 1.0], axis, mode="nearest")
        for axis in (2, 1)
    )
    return np.stack([xx - yy, 2 * np.gradient(np.gradient(light, axis=1), axis=2)])


def _of_gamma(light: Array) -> Array:
    """(1, n, y, x): I^(1 + e) of light I over its peak is I + e I ln I."""
    share = np.maximum(light / light.max(), 1e-6)
    return np.asarray((share * np.log(share))[None])


def _of_mosaic(light: Array) -> Array:
    """(3, n, y, x): light of every second pixel, as waves over rows, columns and both;
    the fourth share is the gain.
    """
    y, x = ((-1.0) ** np.arange(n) for n in light.shape[1:])
    return np.stack([light * y[:, None], light * x, light * y[:, None] * x])


def _curvature(light: Array) -> Array:
    return np.stack([ndimage.laplace(frame, mode="nearest") for frame in light])
