"""What misplaced write fields do to the point-spread function."""

from dataclasses import dataclass

import numpy as np

from layout.mask.fields import FieldPlan
from layout.process.process import Process
from layout.study.focus import FocusSums, FocusWindow, focus_window, prepare_focus
from metalens.core.arrays import Array
from metalens.fabrication import designed_transmission
from metalens.lens import Lens
from metalens.psf import find_peak

_BAND = 64


@dataclass(frozen=True, eq=False, slots=True)
class StitchReport:
    """Change of the point-spread function over random field offsets, uniform within +-
    ``stitching_nm`` along x and y.

    strehl: (draws,) peak intensity relative to perfect fields.
    change: (draws,) relative L2 change of the PSF on the window.
    moved_nm: (draws,) move of its centroid.
    psf, worst_psf: (y, x) intensity of perfect fields and of the draw that changes
    most; window: where.
    fields: that hold pillars. seed: of the draws.
    """

    stitching_nm: float
    strehl: Array
    change: Array
    moved_nm: Array
    psf: Array
    worst_psf: Array
    window: FocusWindow
    fields: int
    seed: int


def simulate_stitching(
    lens: Lens, plan: FieldPlan, process: Process, *, draws: int = 500, seed: int = 0
) -> StitchReport:
    """Draw field offsets and see the focus of the design source change.

    The mean offset of the fields, which only moves the image, is taken out of each
    draw.

    Args:
        lens: as designed.
        plan: write fields.
        process: stitching error.
        draws: number of them.
        seed: of the draws.

    Accuracy:
        terms beyond the second order in the offset: (k NA offset)^3 / 6, below 1e-5 at
        20 nm and NA 0.25.
    """
    focus = prepare_focus(lens, focus_window(lens))
    held, moments = field_moments(lens, plan, focus)
    step = max(process.write_field.stitching_nm, 1.0) * 1e-3
    still, terms = _expansion(focus, moments, step)
    rng = np.random.default_rng(seed)
    offsets = (
        rng.uniform(-1, 1, (draws, held, 2))
        * process.write_field.stitching_nm
        * 1e-3
        / step
    )
    offsets -= offsets.mean(axis=1, keepdims=True)
    x, y = offsets[..., 0], offsets[..., 1]
    factors = np.stack([x, y, x**2 / 2, y**2 / 2, x * y], axis=1).reshape(draws, -1)
    light = still + np.tensordot(factors, terms.reshape(-1, *still.shape), axes=1)
    perfect = abs(still) ** 2
    psf = abs(light) ** 2
    change = np.sqrt(((psf - perfect) ** 2).sum((1, 2)) / (perfect**2).sum())
    moved = (
        np.hypot(
            *(_centroid(psf, focus.window) - _centroid(perfect[None], focus.window))
        )
        * 1e3
    )
    worst = int(change.argmax())
    strehl = np.array([find_peak(image)[2] for image in psf]) / find_peak(perfect)[2]
    return StitchReport(
        process.write_field.stitching_nm,
        strehl,
        change,
        moved,
        perfect,
        psf[worst],
        focus.window,
        held,
        seed,
    )


def field_moments(lens: Lens, plan: FieldPlan, focus: FocusSums) -> tuple[int, Array]:
    """(fields that hold pillars, (fields, nodes y, nodes x) sums of their pillars).

    Args:
        lens: as designed.
        plan: write fields.
        focus: sums of a window.
    """
    found = []
    for rows, columns in plan.blocks():
        if not lens.diameters.diameter_um[rows, columns].any():
            continue
        total = np.zeros((len(focus.nodes_y_um), len(focus.nodes_x_um)), complex)
        for start in range(rows.start, rows.stop, _BAND):
            band = slice(start, min(start + _BAND, rows.stop))
            total += focus.project(
                _amplitude(lens, band, columns)[None], band, columns
            )[0]
        found.append(total)
    return len(found), np.stack(found)


def _amplitude(lens: Lens, rows: slice, columns: slice) -> Array:
    d = lens.diameters.diameter_um[rows].astype(float)
    long = lens.diameters.length_um
    if lens.pairs is not None and long is not None:
        return lens.pairs.amplitude(d, long[rows], lens.wavelength_um, lens.light)[
            :, columns
        ].astype(np.complex64)
    inside = np.where(d > 0, d, lens.proxy.domain_um[0])
    t = designed_transmission(lens.proxy, inside, lens.wavelength_um) * np.exp(
        1j * lens.geometric_rad(rows)
    )
    return np.where(d > 0, t, 0)[:, columns].astype(np.complex64)


def _expansion(focus: FocusSums, moments: Array, step_um: float) -> tuple[Array, Array]:
    """((y, x) light of all fields, (5, fields, y, x) derivatives by x, y, xx, yy, xy,
    in units of the step).
    """
    h = step_um

    def at(x: float, y: float) -> Array:
        return np.asarray(focus.light(moments, (x, y))[:, 0])

    still = at(0, 0)
    right = at(h, 0)
    left = at(-h, 0)
    down = at(0, h)
    up = at(0, -h)
    cross = (at(h, h) + at(-h, -h) - right - left - down - up) / 2 + still
    terms = [
        (right - left) / 2,
        (down - up) / 2,
        right + left - 2 * still,
        down + up - 2 * still,
        cross,
    ]
    return still.sum(0), np.stack(terms)


def _centroid(psf: Array, where: FocusWindow) -> Array:
    total = psf.sum((1, 2))
    return np.stack(
        [(psf.sum(1) @ where.x_um) / total, (psf.sum(2) @ where.y_um) / total]
    )
