"""The kernel's factors against the kernel, its node counts by convergence, and windows
as wide as the lens is far.
"""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.inference.search import prior_of
from characterize.model.forward import ForwardModel, FrameSetting
from characterize.model.glass import BenchGeometry
from characterize.model.kernel import (
    SINGLE,
    CompressedKernel,
    complex_precision,
    least_tolerance,
    low_rank_factors,
    wrapped_phasors,
)
from characterize.model.parameters import KnownValue
from characterize.model.pillars import PillarChange, PillarResponse
from characterize.model.reduced import CompressedLens
from metalens import design, profiles
from metalens.cell.record import Cell
from metalens.core import legendre
from metalens.core.errors import FitError
from metalens.core.paths import source_path

K = 2 * math.pi / 0.85
# nominal distance, actual over nominal, lens radius or half sides (x, y), half window,
# tangents; um
CASES = {
    "millimetre": (2000.0, 1.003, 500.0, 60.0, (0.0, 0.0)),
    "oblique": (2000.0, 1.0, 500.0, 60.0, (0.3, 0.2)),
    "as wide as far": (20.0, 1.0, 10.0, 10.0, (0.0, 0.0)),
    "wide and oblique": (20.0, 1.1, 8.0, 10.0, (0.3, -0.1)),
    "twice as wide": (20.0, 0.9, 8.0, 20.0, (0.0, 0.0)),
    "four times as wide": (10.3, 1.0, 4.5, 21.3, (0.0, 0.0)),
    "of a narrow lens": (20.0, 1.0, (0.7, 12.0), 30.0, (0.0, 0.0)),
    "of a low lens": (20.0, 1.0, (12.0, 0.7), 30.0, (0.0, 0.0)),
}
MOST = (
    14,
    16,
    24,
    26,
    46,
    66,
    84,
    84,
)  # nodes across the window; its own path bends by 13 to 326 rad


def case(name):
    """(kernel, half window)."""
    distance, share, radius, half, (tx, ty) = CASES[name]
    edge, (wide, high) = np.linspace(-1, 1, 41), np.broadcast_to(radius, 2)
    x, y = np.meshgrid(wide * edge - distance * tx, high * edge - distance * ty)
    p, q = (
        x / np.sqrt(x**2 + y**2 + distance**2),
        y / np.sqrt(x**2 + y**2 + distance**2),
    )
    spans = (float(p.min()), float(p.max())), (float(q.min()), float(q.max()))
    return CompressedKernel(K, *spans, distance, distance * share, (tx, ty)), half


def places(kernel, half, count=120):
    """Random (p, q), and (X, Y) with the corners of the window; (1, count) and (count,
    1).
    """
    rng = np.random.default_rng(5)
    p, q = (rng.uniform(*span, (1, count)) for span in (kernel.p, kernel.q))
    X, Y = rng.uniform(-half, half, (2, count, 1))
    X[:4, 0], Y[:4, 0] = half * np.array([[1, -1, 1, -1], [1, 1, -1, -1]])
    return p, q, X, Y


@pytest.mark.parametrize("name", CASES)
def test_factors_times_the_rest_are_the_kernel(name):
    """Distances between points in space, in long double; single precision of the rest
    leaves 3e-6.
    """
    kernel, half = case(name)
    p, q, X, Y = places(kernel, half)
    z = np.longdouble(kernel.nominal_um) / np.sqrt(1 - p**2 - q**2).astype(
        np.longdouble
    )
    d, (tx, ty) = np.longdouble(kernel.distance_um), kernel.tangents
    on_lens = kernel.nominal_um * tx + z * p, kernel.nominal_um * ty + z * q
    r = np.sqrt((d * tx + X - on_lens[0]) ** 2 + (d * ty + Y - on_lens[1]) ** 2 + d**2)
    r_w = np.sqrt((d * tx - on_lens[0]) ** 2 + (d * ty - on_lens[1]) ** 2 + d**2)
    turn = np.exp(1j * np.asarray(np.remainder(K * (r - r_w), 2 * np.pi), float))
    want = (
        np.asarray(d / (2 * np.pi * r**2), float)
        * np.asarray(1 / r - 1j * K, complex)
        * turn
    )
    along = np.exp(1j * K * (kernel.by_x(p, X) + kernel.by_y(q, Y)))
    found = kernel.rest(p, q, X, Y) * along * kernel.window(X, Y)
    assert np.abs(found - want).max() < 3e-6 * np.abs(want).max()


def interpolated(kernel, half, counts, at):
    """The rest at random places from its nodes."""
    (w, m), (p, q, X, Y) = counts, at

    def basis(count, values, low, high):
        return legendre.interpolation_matrix(
            count, (2 * values.ravel() - low - high) / (high - low)
        )

    node = legendre.mapped_nodes(w, -half, half)
    P, Q = (
        legendre.mapped_nodes(m, *kernel.p),
        legendre.mapped_nodes(m, *kernel.q)[:, None],
    )
    table = np.stack(
        [kernel.rest(P, Q, node[:, None, None], height) for height in node]
    )
    here = np.einsum(
        "nj,ni->nji", basis(w, Y, -half, half), basis(w, X, -half, half)
    ).reshape(-1, w * w)
    there = np.einsum(
        "nj,ni->nji", basis(m, q, *kernel.q), basis(m, p, *kernel.p)
    ).reshape(-1, m * m)
    return here @ table.reshape(w * w, m * m) @ there.T


@pytest.mark.parametrize(("name", "most"), list(zip(CASES, MOST, strict=True)))
def test_nodes_suffice_and_are_few(name, most):
    """A tenth of the tolerance of a fit in the mean over random places; half the nodes
    are too few where it matters.
    """
    kernel, half = case(name)
    at = places(kernel, half)
    counts = kernel.counts(half, half)
    exact = kernel.rest(*at)
    error = np.linalg.norm(
        interpolated(kernel, half, counts, at) - exact
    ) / np.linalg.norm(exact)
    assert error < 1e-4
    assert counts[0] <= most
    if half >= kernel.nominal_um:
        few = counts[0] // 2, counts[1] // 2
        assert np.linalg.norm(
            interpolated(kernel, half, few, at) - exact
        ) > 1e-2 * np.linalg.norm(exact)


@pytest.mark.parametrize("tolerance", [1e-2, 5e-4])
def test_factors_are_those_of_the_singular_values(tolerance):
    rng = np.random.default_rng(3)
    u, v = (
        np.linalg.qr(rng.normal(size=(n, 90)) + 1j * rng.normal(size=(n, 90)))[0]
        for n in (150, 120)
    )
    size = np.exp(-0.12 * np.arange(90))
    table = ((u * size) @ v.conj().T).astype(np.complex64)
    columns, rows, remainder = low_rank_factors(table, tolerance)
    left = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / (size**2).sum())
    assert np.linalg.norm(columns @ rows - table) < 1.05 * tolerance * np.linalg.norm(
        table
    )
    assert abs(len(remainder) - (left > tolerance).sum()) <= 1
    assert np.allclose(remainder, left[: len(remainder)], rtol=0.1)


def test_factors_of_a_table_without_structure_are_all_of_it():
    table = np.random.default_rng(0).normal(size=(30, 40)).astype(np.complex64)
    columns, rows, _ = low_rank_factors(table, 1e-5)
    assert columns.shape == (30, 30)
    assert np.abs(columns @ rows - table).max() < 1e-5


def falling(kind):
    """(160, 140) table whose singular values fall to 1e-14 of the largest: below them
    all there is rounding alone.
    """
    rng = np.random.default_rng(8)
    u, v = (
        np.linalg.qr(rng.normal(size=(n, 140)) + 1j * rng.normal(size=(n, 140)))[0]
        for n in (160, 140)
    )
    return ((u * np.exp(-0.23 * np.arange(140))) @ v.conj().T).astype(kind)


@pytest.mark.parametrize("kind", [np.complex64, np.complex128])
def test_what_the_precision_of_a_table_holds_is_met_in_any_order_of_sums_and_the_rest_refused(
    kind,
):
    """Rows and columns in another order are sums in another order: what another
    processor's products differ by.
    """
    table = falling(kind)
    least, rng = least_tolerance(table), np.random.default_rng(2)
    for tolerance in np.geomspace(1e-2, 1.01 * least, 6):
        for _ in range(3):
            mixed = table[rng.permutation(160)][:, rng.permutation(140)]
            columns, rows, _ = low_rank_factors(mixed, tolerance)
            left = np.linalg.norm(
                columns.astype(complex) @ rows - mixed
            ) / np.linalg.norm(mixed)
            rounding = np.finfo(kind).eps * math.sqrt(
                160
            )  # of the factors and of this product
            assert (
                left < 1.05 * tolerance + rounding
            )  # the search stops at a fifth of it: sqrt(1 + 0.2²)
            overlap = columns.conj().T @ columns - np.eye(columns.shape[1])
            assert (
                np.abs(overlap).max() < 20 * np.finfo(kind).eps
            )  # products of 160 terms
    with pytest.raises(FitError, match=np.dtype(kind).name):
        low_rank_factors(table, 0.9 * least)


def test_no_kind_of_number_is_chosen_that_does_not_hold_the_tolerance():
    assert complex_precision(SINGLE) is np.complex64
    assert complex_precision(0.99 * SINGLE) is np.complex128
    largest = np.empty(
        (1, 20_000), np.complex64
    )  # more than the columns of any window here: 66² and 61² nodes
    assert least_tolerance(largest) < SINGLE
    for impossible in (1e-10, 0.0, math.nan, 1.0):
        with pytest.raises(FitError, match="tolerance"):
            complex_precision(impossible)


def test_phases_are_wrapped_before_they_lose_digits():
    phase = np.linspace(-1e7, 1e7, 1001)
    assert np.abs(wrapped_phasors(phase) - np.exp(1j * phase)).max() < 1e-6


def near_lens(width_um=20.0):
    """As wide as far from its sensor: half angle 27 degrees, 35 in the corners of its
    square.
    """
    focus = profiles.Focus(0.85, width_um, 15 * width_um)
    phase = design.phase_of(None, focus, radius_um=width_um / 2)
    return design.make(
        phase, focus, aperture_um=width_um, cell=Cell(pitch_um=0.4), proxy=b.proxy()
    )[0]


@pytest.mark.parametrize("tangents", [(0.0, 0.0), (0.21, -0.1)])
def test_a_tighter_tolerance_is_met_and_never_gives_a_worse_field(tangents):
    """Against the sum over every pillar in double precision, at 25 places; nodes leave
    a tenth of the tolerance.
    """
    lens, axis, z = near_lens(9.2), np.linspace(-6.3, 6.3, 29), 120.0
    pillars, d = PillarResponse(lens, b.RESPONSE), lens.sensor_distance_um
    nominal = pillars.coefficients(PillarChange())[0]
    rows, columns = np.nonzero(lens.diameters.diameter_um)
    x, y = lens.diameters.x_um[columns], lens.diameters.y_um[rows]
    t = (
        nominal
        @ pillars.table()[:, pillars.place(lens.diameters.diameter_um[rows, columns])]
    )
    lit = t * np.exp(
        1j
        * K
        * (np.sqrt((x + z * tangents[0]) ** 2 + (y + z * tangents[1]) ** 2 + z**2))
    )
    some = np.array([0, 4, 13, 20, 28])
    v, u = (
        g[..., None]
        for g in np.meshgrid(
            axis[some] + d * tangents[1], axis[some] + d * tangents[0], indexing="ij"
        )
    )
    r = np.sqrt((u - x) ** 2 + (v - y) ** 2 + d**2)
    want = (lit * d / (2 * np.pi * r**2) * (1 / r - 1j * K) * np.exp(1j * K * r)).sum(
        -1
    ) * 0.4**2
    bench_, depths, errors = (
        BenchGeometry(d, 0.85, 138.0, tangents),
        np.array([100.0, 170.0]),
        [],
    )
    tolerances = (1e-2, 1e-3, SINGLE, 0.3 * SINGLE, 5e-6, 1e-7)
    for tolerance in tolerances:
        reduced = CompressedLens(
            lens, pillars, bench_, window_um=24.0, depths_um=depths, tolerance=tolerance
        )
        operators = reduced.operators(
            wavelength_um=0.85, distance_um=d, axes_um=(axis, axis)
        )
        away = [
            source_path(reduced.x_um, reduced.y_um, tangents, 1 / depth)
            for depth in (z, 138.0)
        ]
        light = np.tensordot(nominal, reduced.gathered, 1) * np.exp(
            1j * K * (away[0] - away[1])
        )
        found = operators.field(light)[np.ix_(some, some)]
        found = (
            found * np.vdot(found, want) / np.abs(np.vdot(found, want))
        )  # phase of the axis: left out
        errors.append(np.linalg.norm(found - want) / np.linalg.norm(want))
    assert (np.array(errors) < np.array(tolerances)).all(), errors
    assert (np.diff(errors) < 0).all(), errors


@pytest.mark.parametrize("angle_deg", [0.0, 12.0])
def test_window_as_wide_as_the_distance_agrees_with_the_sum_over_every_pillar(
    angle_deg,
):
    """Pillars and window operators leave 5e-4 of the field each; 20 pixels of 1 um, and
    8 of margin for the blur.
    """
    lens, depths = near_lens(), (250.0, 330.0)
    values = {
        "bias_nm": 2.0,
        "height_nm": -4.0,
        "coma_x_rad": 0.2,
        "crosstalk_px": 0.25,
    }
    known = tuple(KnownValue(name, value) for name, value in values.items())
    truth = HiddenLens(
        depths,
        parameter=known,
        camera=BenchCamera(pixel_um=1.0, pixels=20),
        angles_deg=(angle_deg,),
    )
    want = bench.bench_irradiance(lens, truth, b.RESPONSE)
    setting = FrameSetting(*truth.stated, np.ones(2), 1.0, 20, 20)
    model = ForwardModel(lens, setting, b.RESPONSE)
    found = model.images(truth.vector())[0]
    found *= (found * want).sum() / (found**2).sum()
    assert np.abs(found - want).max() < 1e-3 * want.max()
    finer = ForwardModel(lens, dataclasses.replace(setting, tolerance=3e-5), b.RESPONSE)
    same = finer.images(truth.vector())[0]
    same *= (same * want).sum() / (same**2).sum()
    assert np.abs(same - found).max() < 5e-4 * want.max()


def test_no_search_takes_the_sensor_into_the_lens():
    prior = prior_of(
        ("distance_um", "bias_nm"),
        {},
        dataclasses.replace(b.lens(), sensor_distance_um=10.0),
    )
    assert (prior.low[0], prior.high[0]) == (-2.5, 2.5)
    far = prior_of(
        ("distance_um",), {}, dataclasses.replace(b.lens(), sensor_distance_um=1e4)
    )
    assert (far.low[0], far.high[0]) == (-400.0, 400.0)


@pytest.mark.parametrize(
    "name", ["millimetre", "oblique", "wide and oblique", "of a low lens"]
)
def test_a_path_rises_over_the_window_by_the_cosines_of_its_ray(name):
    """Against differences of the path over 1e-3 um: of third order, 1e-6 / d² of 1, and
    rounding of 60 um over them.
    """
    kernel, half = case(name)
    p, q, X, Y = places(kernel, half, 40)
    step = 1e-3
    by_x = (kernel.path(p, q, X + step, Y)[0] - kernel.path(p, q, X - step, Y)[0]) / (
        2 * step
    )
    by_y = (kernel.path(p, q, X, Y + step)[0] - kernel.path(p, q, X, Y - step)[0]) / (
        2 * step
    )
    found = kernel._steep(p, q, X, Y)
    assert np.abs(found[0] - by_x).max() < 1e-8
    assert np.abs(found[1] - by_y).max() < 1e-8
    a, b_ = (sum(span) / 2 for span in (kernel.p, kernel.q))
    off = kernel.turning(p, q, X, Y)
    for axis, (rise, middle) in enumerate(
        zip((by_x, by_y), ((X, 0.0), (0.0, Y)), strict=True)
    ):
        moved = [
            (middle[0] + s * step * (axis == 0), middle[1] + s * step * (axis == 1))
            for s in (1, -1)
        ]
        own = (kernel.path(a, b_, *moved[0])[0] - kernel.path(a, b_, *moved[1])[0]) / (
            2 * step
        )
        assert np.abs(off[axis] - (rise - own)).max() < 2e-8
    high, wide = kernel.bands(half, 0.6 * half)
    t = np.linspace(-1, 1, 9)
    Y, X, q, p = np.meshgrid(
        half * t,
        0.6 * half * t,
        *((sum(s) / 2 + (s[1] - s[0]) / 2 * t) for s in (kernel.q, kernel.p)),
        indexing="ij",
    )
    most = [float(np.abs(part).max()) for part in kernel.turning(p, q, X, Y)]
    assert (wide, high) == pytest.approx((K * most[0], K * most[1]), rel=1e-9)
