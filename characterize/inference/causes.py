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

_STITCH_UM = 0.05
_STOP_UM = 3.0
_WALL_DEG = 1.5
_LIGHT_STEP = 0.2
_ENOUGH = 4e-3
_CAMERA_DEG, _TALL = 0.5, 0.01
_DENSE = 3  # samples a pixel's side between which turned frames are interpolated
LAMP = "a lamp or exposure that changes from frame to frame"
WINDOWS = "a window off the chief ray at a field angle"
_ROUND = (
    1e-4  # of the peak: round light does not turn, what is left is of the interpolation
)
_GRID = 41  # places across the lens at which write fields are sampled

_TILTED = {"glass_um": 100.0, "glass_tilt_x_deg": 0.0, "glass_tilt_y_deg": 0.0}
_SQUARE = ("pinhole_um", "bandwidth_nm")  # blur acts as the square of its size
_OF_MASK = {*names_of_kind(CDError), *names_of_kind(ResponseError)}


@dataclass(frozen=True, eq=False, slots=True)
class ImageChange:
    """A cause that is not fitted, and (k, n, y, x) changes of the images by it.

    amount, amount_text: of the first, in words with a place for the number; empty where no
    amount is said.
    sigma: of every change, one for all or each its own, how much of it is assumed
    where nobody states it: a
    standard deviation, 0 for none.
    frees: parameters that describe it. stated: whether one of these is stated without
    an error. sought: whether it is looked for alone.
    roughly: the change is of the right kind but of an unknown pattern, so that the
    frames cannot bound it by what they
    show of it. of_mask: of the lens itself.
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
    """Every cause that is not among the fitted parameters; ``slopes``: of these.

    From differences of images that leave ``_ENOUGH`` of a field out: what causes are
    taken for moves by a percent.

    Args:
        task: model, frames, priors and arrangement of the search.
        x: all parameters, in the order of ``PARAMETERS``.
    """
    task = dataclasses.replace(
        task, model=task.model.rough(max(task.model.cut, _ENOUGH))
    )
    image = task.model.images(x)[0]
    yield from _of_model(task, x, image)
    if "sidewall_deg" not in task.names or task.model.lens.cell.sidewall_rad == 0:
        leaning = task.model.with_walls(math.radians(_WALL_DEG)).images(x)[0] - image
        amount_text = "an angle whose square is {:.3g} deg²"
        sigma = (_size(task, "sidewall_deg") / _WALL_DEG) ** 2
        words = "a side wall that leans about half height"
        # resonances are left out of it
        yield ImageChange(
            words,
            leaning[None],
            _WALL_DEG**2,
            amount_text,
            sigma,
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
    held = tuple(name for name in LIGHT if name not in task.names)
    if held:
        uneven = _LIGHT_STEP * np.asarray(task.model.images(x, held)[1])
        sizes = np.array([_size(task, name) for name in held]) / _LIGHT_STEP
        frees = tuple(name for name in held if not _exactly(task, name))
        yield ImageChange(
            "uneven illumination",
            uneven,
            _LIGHT_STEP,
            held[0] + " {:.3g}",
            sizes,
            frees or held,
            not frees,
        )
    yield from _of_phase(task, x, image, slopes)


def _of_model(task: SearchTask, x: Array, image: Array) -> Iterator[ImageChange]:
    """Parameters of the model that are held."""
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
        with contextlib.suppress(
            FitError
        ):  # a spectrum wider than the proxy knows, a plate with no room
            first = task.model.images(before)[0] if base else image
            change = (task.model.images(after)[0] - first)[None]
            sigma = (_size(task, name) / amount) ** (2 if name in _SQUARE else 1)
            words = row.effect.format(before[PLACE["glass_um"]])
            frees = ("glass_um", name) if base else (name,)
            yield ImageChange(
                words,
                change,
                amount,
                name + " {:.3g}",
                sigma,
                frees,
                _exactly(task, name),
                of_mask=name in _OF_MASK,
            )


def _of_frames(light: Array, slopes: dict[str, Array]) -> Iterator[ImageChange]:
    """What changes from frame to frame."""
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
    """Pixels that lie elsewhere: along turned axes, or farther apart along y.

    Pixels that are higher too blur by a share of their own width more, which is left
    out.
    """
    places = np.eye(2), _turn(_CAMERA_DEG), np.diag([1 + _TALL, 1.0])
    upright, *moved = seen_at(task.model, x, places)
    turned, tall = (frames - upright for frames in moved)
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
    """Windows of one field angle moved along x and along y, at every angle but the
    first: decentre moves them all.
    """
    s = task.model.setting
    sideways = [
        slopes[name] * s.pixel_um
        for name in ("decentre_x_um", "decentre_y_um")
        if name in slopes
    ]
    aside = [one.index for one in task.model.groups[1:]]
    if aside and sideways:
        moved = np.zeros((len(aside), len(sideways), *sideways[0].shape))
        for k, index in enumerate(aside):
            moved[k, :, index] = np.stack(sideways, 1)[index]
        amount_text = "{:.3g} px at one of the angles"
        yield ImageChange(
            WINDOWS,
            moved.reshape(-1, *sideways[0].shape),
            1.0,
            amount_text,
            _size(task, "window_px"),
        )


def _of_stop(task: SearchTask, x: Array, image: Array) -> Iterator[ImageChange]:
    """An aperture stop beside its place: the part of the lens that the light meets
    moves, as by a lean of the lens.
    """
    model, stop = task.model, task.model.lens.layers.stop
    if stop is None:
        return
    for along in (0, 1):
        centre = np.add(stop.centre_um, _STOP_UM * np.eye(2)[along])
        moved = model_behind_stop(
            model,
            dataclasses.replace(stop, centre_um=(float(centre[0]), float(centre[1]))),
        ).images(x)[0]
        amount_text = "{:.3g} um"
        sigma = _size(task, "stop_um") / _STOP_UM
        yield ImageChange(
            f"an aperture stop off along {'xy'[along]}",
            (moved - image)[None],
            _STOP_UM,
            amount_text,
            sigma,
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
    """Phases that no parameter describes: half of the mask off, smooth ones, write
    fields.
    """
    model = task.model
    for along, name in enumerate("xy"):
        shape = _field_off(model.lens, along)
        moved = model.with_residual(np.array([_STITCH_UM]), shape).images(x)[0] - image
        amount_text = "{:.3g} nm of the right half"
        yield ImageChange(
            f"a write field off along {name}",
            moved[None],
            _STITCH_UM * 1e3,
            amount_text,
        )
    names = [f"residual_{k}" for k in range(MODES + 3)]
    bent = np.asarray(
        model.with_residual(np.zeros(MODES + 3), smooth_phase_changes).images(x, names)[
            1
        ]
    )
    sized = bent[:MODES] * prior_rad()[:, None, None, None]
    yield ImageChange("a smooth phase that no parameter describes", sized)
    known = [
        slopes.get(name, np.zeros_like(image)) for name in names_of_kind(WavefrontError)
    ]
    every = np.concatenate([bent, np.stack(known)])
    fields = np.tensordot(write_fields(model.lens), every, 1)
    sigma = _size(task, "stitching_nm") * 1e-3
    yield ImageChange(
        "write fields out of place",
        fields,
        sigma=sigma,
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
    """Standard deviation of a cause: as it is stated, 0 where it
    is held as stated.
    """
    if name in task.unfitted:
        return task.unfitted[name]
    known = task.known.get(name)
    if known is not None:
        return (
            math.hypot(known.sigma, known.value)
            if name == "sidewall_deg"
            else known.sigma
        )
    return type_b_sigma(name, task.model.lens)


def _field_off(lens: Lens, along: int) -> Callable[[Array, Array, int], Array]:
    """Phase for 1 um by which the pillars right of the axis are moved along x (0) or y
    (1).
    """

    def phase(u: Array, v: Array, count: int) -> Array:
        return np.asarray((_moved_phase(lens, u, v, along) * (u > 0))[None])

    return phase


def _moved_phase(lens: Lens, u: Array, v: Array, along: int) -> Array:
    """Phase for 1 um by which pillars are moved along x (0) or y (1): that of the focus
    there.
    """
    k = 2 * math.pi / lens.wavelength_um
    radius = lens.diameters.radius_um
    d = lens.reduced_um
    r = radius * np.hypot(u, v)
    sine = 1 / np.hypot(r, d) + (
        1 / np.hypot(r, lens.source_distance_um) if lens.source_distance_um > 0 else 0.0
    )
    return np.asarray(k * radius * (u, v)[along] * sine)


def write_fields(lens: Lens) -> Array:
    """(fields, modes and known phases) of :func:`smooth_phase_changes` and the
    wave-front parameters
    for 1 um along x, then y.

    Four fields across the lens each way. What is no smooth phase is left out: it
    scatters light and moves nothing.
    """
    t = np.linspace(-1, 1, _GRID)
    u, v = (part[np.hypot(*np.meshgrid(t, t)) <= 1] for part in np.meshgrid(t, t))
    shapes = np.concatenate(
        [
            smooth_phase_changes(u, v, MODES + 3),
            derivative_maps(WavefrontError, u, v),
            np.ones((1, len(u))),
        ]
    )
    field = (
        np.minimum(np.floor(2 * (v + 1)), 3) * 4 + np.minimum(np.floor(2 * (u + 1)), 3)
    ).astype(int)
    parts = [
        phase * (field == k)
        for phase in (_moved_phase(lens, u, v, a) for a in (0, 1))
        for k in range(16)
    ]
    return np.asarray(
        np.linalg.lstsq(shapes.T, np.array(parts).T, rcond=None)[0][:-1].T
    )


def smooth_phase_changes(u: Array, v: Array, count: int) -> Array:
    """Smooth phases that no parameter describes, then leans and defocus.

    Args:
        u: x on the lens over its radius.
        v: y on the lens over its radius.
        count: of the phases.
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
    """(2, n, y, x): a blur s² wider along x than along y, and along one diagonal than
    the other, is s²/2 of these.

    Second differences of the light, xx - yy and 2 xy: the blur that parameters describe
    is round.
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
    """(k, n, y, x) light, less the background, of pixels as wide as ever that lie
    elsewhere.

    Of frames on samples ``_DENSE`` times as close as pixels, splines of fifth order.

    Args:
        model: the forward model.
        places: k matrices (2, 2) from (y, x) of a pixel, counted from the window's
            middle, to where it lies.
    """
    s, dense = model.setting, _sampled(model, _DENSE)
    close = dense.images(x)[0] - background_planes(x, dense.setting)
    pixels = np.stack(
        np.meshgrid(
            *(np.arange(n) - (n - 1) / 2 for n in (s.rows, s.columns)), indexing="ij"
        )
    )
    middle = np.array([(n - 1) / 2 for n in close.shape[1:]])[:, None, None]
    seen = (middle + _DENSE * np.tensordot(one, pixels, 1) for one in places)
    frames = [
        [ndimage.map_coordinates(frame, at, order=5, mode="nearest") for frame in close]
        for at in seen
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
    s, over = model.setting, math.ceil(model.grid.oversample / dense)
    rows = dense * s.rows
    columns = dense * s.columns
    margin = dense * s.margin
    now: dict[str, Any] = {"rows": rows, "columns": columns, "margin": margin}
    now |= {"pixel_um": s.pixel_um / dense, "fill": dense * s.fill}
    part.setting = dataclasses.replace(s, **now)
    part.grid = dataclasses.replace(model.grid, **now, oversample=over)
    return part
