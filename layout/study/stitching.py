"""What misplaced write fields do to the point-spread function."""

import itertools
from dataclasses import dataclass

import numpy as np

from layout.mask.fields import FieldPlan
from layout.process.process import Process
from layout.study.focus import FocusSums, focus_window, prepare_focus
from metalens.core.arrays import Array
from metalens.lens import Lens
from metalens.psf import find_peak


@dataclass(frozen=True, eq=False)
class StitchReport:
    """Change of the PSF over random field offsets, uniform within +- ``stitching_nm``.

    strehl: (draws,) peak intensity relative to perfect fields. change: (draws,)
    relative L2 change of the PSF on the window. fields: number that hold pillars.
    """

    stitching_nm: float
    strehl: Array
    change: Array
    fields: int


def simulate_stitching(
    lens: Lens, plan: FieldPlan, process: Process, *, draws: int = 500, seed: int = 0
) -> StitchReport:
    """Change of the focus over random offsets of the write fields.

    The light is a second-order series in the offset of each field. The mean offset of
    the fields, which only moves the image, is taken out of each draw.

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
    fields, moments = field_moments(lens, plan, focus)
    step = max(process.write_field.stitching_nm, 1.0) * 1e-3
    unmoved, derivatives = _expansion(focus, moments, step)
    rng = np.random.default_rng(seed)
    offsets = (
        rng.uniform(-1, 1, (draws, fields, 2))
        * process.write_field.stitching_nm
        * 1e-3
        / step
    )
    offsets -= offsets.mean(axis=1, keepdims=True)
    x, y = offsets[..., 0], offsets[..., 1]
    factors = np.stack([x, y, x**2 / 2, y**2 / 2, x * y], axis=1).reshape(draws, -1)
    amplitude = unmoved + np.tensordot(
        factors, derivatives.reshape(-1, *unmoved.shape), axes=1
    )
    perfect = abs(unmoved) ** 2
    psf = abs(amplitude) ** 2
    change = np.sqrt(((psf - perfect) ** 2).sum((1, 2)) / (perfect**2).sum())
    strehl = np.array([find_peak(image)[2] for image in psf]) / find_peak(perfect)[2]
    return StitchReport(process.write_field.stitching_nm, strehl, change, fields)


def field_moments(lens: Lens, plan: FieldPlan, focus: FocusSums) -> tuple[int, Array]:
    """(fields that hold pillars, (fields, nodes y, nodes x) sums of their pillars).

    Args:
        lens: as designed.
        plan: write fields.
        focus: sums of a window.
    """
    amplitude = (lens.transmission() * np.exp(1j * lens.phase_rad())).astype(
        np.complex64
    )
    moments = [
        focus.project(amplitude[None, rows, columns], rows, columns)[0]
        for rows, columns in plan.blocks()
        if amplitude[rows, columns].any()
    ]
    return len(moments), np.stack(moments)


def _expansion(focus: FocusSums, moments: Array, step_um: float) -> tuple[Array, Array]:
    """Light of all fields, and its derivatives by the offset of each field.

    Central differences of step h; the mixed derivative is (f(h, h) + f(-h, -h) - f(h,
    0) - f(-h, 0) - f(0, h) - f(0, -h)) / 2 + f(0, 0).

    Args:
        focus: sums of the window.
        moments: (fields, nodes y, nodes x).
        step_um: h.

    Returns:
        (y, x) amplitude, and (5, fields, y, x) derivatives by x, y, xx, yy and xy in
        units of the step.
    """
    f = {
        (i, j): np.asarray(focus.light(moments, (i * step_um, j * step_um))[:, 0])
        for i, j in itertools.product((-1, 0, 1), repeat=2)
        if i * j >= 0
    }
    along_x, along_y = f[1, 0] + f[-1, 0], f[0, 1] + f[0, -1]
    terms = [
        (f[1, 0] - f[-1, 0]) / 2,
        (f[0, 1] - f[0, -1]) / 2,
        along_x - 2 * f[0, 0],
        along_y - 2 * f[0, 0],
        (f[1, 1] + f[-1, -1] - along_x - along_y) / 2 + f[0, 0],
    ]
    return f[0, 0].sum(0), np.stack(terms)
