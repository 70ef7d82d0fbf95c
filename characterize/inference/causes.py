"""Causes that the fit leaves out, each by what it does to the images, and how large it
may be where nobody says.
"""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from characterize.inference.multistart import SearchTask
from characterize.model import (
    LIGHT,
    MODES,
    PARAMETERS,
    PLACE,
    ForwardModel,
    background_planes,
    prior_rad,
    thin_plate_basis,
    type_b_sigma,
)
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import (
    CDError,
    ResponseError,
    WavefrontError,
    derivative_maps,
    names_of_kind,
)
from metalens.lens import Lens
from metalens.optics import Stop

# amounts by which the causes are probed
_STITCH_UM = 0.05
_STOP_UM = 3.0
_WALL_DEG = 1.5
_LIGHT_STEP = 0.2
_CAMERA_DEG, _TALL = 0.5, 0.01
_ENOUGH = 4e-3  # relative error of the fields in these differences
_DENSE = 3  # samples a pixel's side from which turned frames are interpolated
LAMP = "a lamp or exposure that changes from frame to frame"
WINDOWS = "a window off the chief ray at a field angle"
# share of the peak below which a turn of round light is error of interpolation
_ROUND = 1e-4
_GRID = 41  # places across the lens at which write fields are sampled

_TILTED = {"glass_um": 100.0, "glass_tilt_x_deg": 0.0, "glass_tilt_y_deg": 0.0}
_SQUARE = ("pinhole_um", "bandwidth_nm")  # blur acts as the square of its size
_OF_MASK = {*names_of_kind(CDError), *names_of_kind(ResponseError)}


@dataclass(frozen=True, eq=False, slots=True)
class ImageChange:
    """A cause that is not fitted, and (k, n, y, x) changes of the images by it.

    amount: of the cause in the first change. amount_text: sentence part with a place
    for that number; empty where none is reported.
    sigma: standard deviation of the factor of each change, assumed where nobody states
    it; one for all or one for each, 0 for none.
    frees: parameters that describe the cause. stated: whether one of these is stated
    without an error. sought: whether it has a score test of its own.
    roughly: the pattern of the change is not known well enough for the frames to bound
    it. of_mask: the cause belongs to the lens itself.
    """

    cause: str
    images: Array
    amount: float = 0.0
    amount_text: str = ""
    sigma: float | Array = 0.0
    frees: tuple[str, ...] = ()
    stated: bool = False
    sought: bool = True
    roughly: bool = False
    of_mask: bool = False


def systematic_changes(
    task: SearchTask, x: Array, slopes: dict[str, Array]
) -> Iterator[ImageChange]:
    """Changes of the images by every systematic effect that is not fitted.

    Differences of images with fields to ``_ENOUGH``: the shifts of parameters that are
    computed from these change by a percent.

    Args:
        task: model, frames, priors and arrangement of the search.
        x: all parameters, in the order of ``PARAMETERS``.
        slopes: derivatives of the images by the fitted parameters.
    """
    rough = task.model.rough(max(task.model.cut, _ENOUGH))
    task = dataclasses.replace(task, model=rough)
    image = task.model.images(x)[0]
    yield from _of_model(task, x, image)
    if "sidewall_deg" not in task.names or task.model.lens.cell.sidewall_rad == 0:
        leaning = task.model.with_walls(math.radians(_WALL_DEG)).images(x)[0] - image
        # roughly: resonances are left out
        yield ImageChange(
            "a side wall that leans about half height",
            leaning[None],
            _WALL_DEG**2,
            "an angle whose square is {:.3g} deg²",
            (_size(task, "sidewall_deg") / _WALL_DEG) ** 2,
            roughly=True,
            of_mask=True,
        )
    light = image - background_planes(x, task.model.setting)
    yield ImageChange("vibration or blur along one direction", _along_one(light))
    yield ImageChange(
        "pixels of 2 x 2 that see unlike shares of the light (a raw colour mosaic)",
        _of_mosaic(light),
    )
    yield ImageChange(
        "counts that are not in proportion to the light (a gamma)", _of_gamma(light)
    )
    if len(image) > 2:
        yield from _of_frames(light, slopes)
    yield from _of_windows(task, slopes)
    yield from _of_camera(task, x, light)
    yield from _of_stop(task, x, image)
    fixed = tuple(name for name in LIGHT if name not in task.names)
    if fixed:
        uneven = _LIGHT_STEP * np.asarray(task.model.images(x, fixed)[1])
        sizes = np.array([_size(task, name) for name in fixed]) / _LIGHT_STEP
        frees = tuple(name for name in fixed if not _exactly(task, name))
        yield ImageChange(
            "uneven illumination",
            uneven,
            _LIGHT_STEP,
            fixed[0] + " {:.3g}",
            sizes,
            frees or fixed,
            not frees,
        )
    yield from _of_phase(task, x, image, slopes)


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
                amount,
                name + " {:.3g}",
                (_size(task, name) / amount) ** (2 if name in _SQUARE else 1),
                ("glass_um", name) if base else (name,),
                _exactly(task, name),
                of_mask=name in _OF_MASK,
            )


def _of_frames(light: Array, slopes: dict[str, Array]) -> Iterator[ImageChange]:
    """Changes of single frames: brightness, shifts, blur, stage, and wavelength drift."""
    yield ImageChange(LAMP, _each(light))
    sideways = [_each(np.gradient(light, axis=a)) for a in (1, 2)]
    yield ImageChange("shifts from frame to frame", np.concatenate(sideways))
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


def _of_camera(task: SearchTask, x: Array, light: Array) -> Iterator[ImageChange]:
    """Changes by pixels at other places: turned axes, or a larger pitch along y.

    The added blur of higher pixels is left out.
    """
    places = np.eye(2), _turn(_CAMERA_DEG), np.diag([1 + _TALL, 1.0])
    frames = seen_at(task.model, x, places)
    turned = frames[1] - frames[0]
    tall = frames[2] - frames[0]
    if np.abs(turned).max() > _ROUND * light.max():
        sigma = _size(task, "camera_turn_deg") / _CAMERA_DEG
        yield ImageChange(
            "a camera that is turned",
            turned[None],
            _CAMERA_DEG,
            "{:.3g} deg against the lens",
            sigma,
        )
    yield ImageChange("pixels that are not as high as wide", tall[None])


def _of_windows(task: SearchTask, slopes: dict[str, Array]) -> Iterator[ImageChange]:
    """Changes by windows of one field angle that are off by a pixel along x and y.

    At every angle but the first, as decentre moves all windows.
    """
    s = task.model.setting
    sideways = [
        slopes[name] * s.pixel_um
        for name in ("decentre_x_um", "decentre_y_um")
        if name in slopes
    ]
    indices = [group.index for group in task.model.groups[1:]]
    if indices and sideways:
        moved = np.zeros((len(indices), len(sideways), *sideways[0].shape))
        for k, index in enumerate(indices):
            moved[k, :, index] = np.stack(sideways, 1)[index]
        yield ImageChange(
            WINDOWS,
            moved.reshape(-1, *sideways[0].shape),
            1.0,
            "{:.3g} px at one of the angles",
            _size(task, "window_px"),
        )


def _of_stop(task: SearchTask, x: Array, image: Array) -> Iterator[ImageChange]:
    """Changes by an aperture stop off its place, along x and along y.

    The illuminated part of the lens moves, as by a tilt of the lens.
    """
    stop = task.model.lens.layers.stop
    if stop is None:
        return
    for along in (0, 1):
        centre = np.add(stop.centre_um, _STOP_UM * np.eye(2)[along])
        centre_um = float(centre[0]), float(centre[1])
        displaced = dataclasses.replace(stop, centre_um=centre_um)
        moved = model_behind_stop(task.model, displaced).images(x)[0]
        yield ImageChange(
            f"an aperture stop off along {'xy'[along]}",
            (moved - image)[None],
            _STOP_UM,
            "{:.3g} um",
            _size(task, "stop_um") / _STOP_UM,
        )


def model_behind_stop(model: ForwardModel, stop: Stop) -> ForwardModel:
    """The model of the same lens behind another stop."""
    part = copy.copy(model)
    part.lens = dataclasses.replace(
        model.lens, layers=dataclasses.replace(model.lens.layers, stop=stop)
    )
    part.groups = [
        group.shaded(part.lens, model.setting.depth_um) for group in model.groups
    ]
    return part


def _of_phase(
    task: SearchTask, x: Array, image: Array, slopes: dict[str, Array]
) -> Iterator[ImageChange]:
    """Changes by phases that no parameter describes.

    Half of the mask displaced, smooth phases, and write fields displaced at random.
    """
    model = task.model
    for along, name in enumerate("xy"):
        shape = _field_off(model.lens, along)
        moved = model.with_residual(np.array([_STITCH_UM]), shape).images(x)[0] - image
        yield ImageChange(
            f"a write field off along {name}",
            moved[None],
            _STITCH_UM * 1e3,
            "{:.3g} nm of the right half",
        )
    names = [f"residual_{k}" for k in range(MODES + 3)]
    smooth = model.with_residual(np.zeros(MODES + 3), smooth_phase_changes)
    bent = np.asarray(smooth.images(x, names)[1])
    sized = bent[:MODES] * prior_rad()[:, None, None, None]
    yield ImageChange("a smooth phase that no parameter describes", sized)
    wavefront = [
        slopes.get(name, np.zeros_like(image)) for name in names_of_kind(WavefrontError)
    ]
    every = np.concatenate([bent, np.stack(wavefront)])
    yield ImageChange(
        "write fields out of place",
        np.tensordot(write_fields(model.lens), every, 1),
        sigma=_size(task, "stitching_nm") * 1e-3,
        sought=False,
        roughly=True,
        of_mask=True,
    )


def _exactly(task: SearchTask, name: str) -> bool:
    """Whether a parameter is stated without an error: it stays as stated, whatever the
    residuals lean to.
    """
    return name in task.known and task.known[name].sigma == 0


def _size(task: SearchTask, name: str) -> float:
    """Standard deviation of a cause: as stated, else a Type B estimate.

    0 where it is held as stated.
    """
    if name in task.unfitted:
        return task.unfitted[name]
    stated = task.known.get(name)
    if stated is None:
        return type_b_sigma(name, task.model.lens)
    if name == "sidewall_deg":  # the model has upright walls: the mean counts too
        return math.hypot(stated.sigma, stated.value)
    return stated.sigma


def _field_off(lens: Lens, along: int) -> Callable[[Array, Array, int], Array]:
    """Phase, rad, of the right half of the pillars moved by 1 um along x (0) or y (1)."""

    def phase(u: Array, v: Array, count: int) -> Array:
        return np.asarray((_moved_phase(lens, u, v, along) * (u > 0))[None])

    return phase


def _moved_phase(lens: Lens, u: Array, v: Array, along: int) -> Array:
    """Phase, rad, of pillars moved by 1 um along x (0) or y (1).

    The slope of the focusing phase, k x (1 / hypot(r, d) + 1 / hypot(r, s)) at place x
    along the axis, with focal distance d and source distance s.
    """
    k = 2 * math.pi / lens.wavelength_um
    radius = lens.diameters.radius_um
    d = lens.reduced_um
    r = radius * np.hypot(u, v)
    # sine of the angle to the focus over r, and to the source where it is near
    sine = 1 / np.hypot(r, d)
    if lens.source_distance_um > 0:
        sine = sine + 1 / np.hypot(r, lens.source_distance_um)
    return np.asarray(k * radius * (u, v)[along] * sine)


def write_fields(lens: Lens) -> Array:
    """Write-field displacements as combinations of smooth phases.

    Least-squares coefficients (fields, phases) of the phase of one field moved by 1 um,
    along x, then along y; four fields across the lens each way. The phases are those of
    :func:`smooth_phase_changes` and the wave-front parameters. What they cannot
    represent scatters light and shifts no parameter.
    """
    t = np.linspace(-1, 1, _GRID)
    u, v = np.meshgrid(t, t)
    inside = np.hypot(u, v) <= 1
    u, v = u[inside], v[inside]
    shapes = np.concatenate(
        [
            smooth_phase_changes(u, v, MODES + 3),
            derivative_maps(WavefrontError, u, v),
            np.ones((1, len(u))),
        ]
    )
    row, column = (np.minimum(np.floor(2 * (w + 1)), 3) for w in (v, u))
    field = (row * 4 + column).astype(int)  # number, 0 to 15
    parts = [
        phase * (field == k)
        for phase in (_moved_phase(lens, u, v, a) for a in (0, 1))
        for k in range(16)
    ]
    return np.asarray(
        np.linalg.lstsq(shapes.T, np.array(parts).T, rcond=None)[0][:-1].T
    )


def smooth_phase_changes(u: Array, v: Array, count: int) -> Array:
    """(count, *shape) smooth phases: thin-plate modes, then tilts and defocus, rad.

    Args:
        u: x on the lens over its radius.
        v: y on the lens over its radius.
        count: number of phases.
    """
    return np.concatenate(
        [thin_plate_basis(u, v, MODES), np.stack([u, v, u * u + v * v])]
    )[:count]


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


def seen_at(model: ForwardModel, x: Array, places: Sequence[Array]) -> Array:
    """(k, n, y, x) light without background of pixels at other places.

    Pixels keep their width. Fifth-order splines on samples ``_DENSE`` times as dense.

    Args:
        model: the forward model.
        x: all parameters.
        places: k matrices (2, 2) from (y, x) of a pixel, counted from the window's
            middle, to its actual place.
    """
    s = model.setting
    dense = _sampled(model, _DENSE)
    light = dense.images(x)[0] - background_planes(x, dense.setting)
    # (y, x) of the pixels from the window's middle
    axes = (np.arange(n) - (n - 1) / 2 for n in (s.rows, s.columns))
    pixels = np.stack(np.meshgrid(*axes, indexing="ij"))
    middle = np.array([(n - 1) / 2 for n in light.shape[1:]])[:, None, None]
    moved = (middle + _DENSE * np.tensordot(place, pixels, 1) for place in places)
    frames = [
        [ndimage.map_coordinates(frame, at, order=5, mode="nearest") for frame in light]
        for at in moved
    ]
    return np.array(frames)


def _turn(turn_deg: float) -> Array:
    """(2, 2) of :func:`seen_at` for a camera turned from +x to +y about its window's
    middle.
    """
    cosine = math.cos(math.radians(turn_deg))
    sine = math.sin(math.radians(turn_deg))
    return np.array([[cosine, sine], [-sine, cosine]])


def _sampled(model: ForwardModel, dense: int) -> ForwardModel:
    """The model of frames whose pixels lie ``dense`` times as close and stay as wide."""
    part = copy.copy(model)
    s = model.setting
    over = math.ceil(model.grid.oversample / dense)
    changes: dict[str, Any] = {
        "rows": dense * s.rows,
        "columns": dense * s.columns,
        "margin": dense * s.margin,
        "pixel_um": s.pixel_um / dense,
        "fill": dense * s.fill,
    }
    part.setting = dataclasses.replace(s, **changes)
    part.grid = dataclasses.replace(model.grid, **changes, oversample=over)
    return part
