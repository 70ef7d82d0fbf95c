"""The kernel between points in space by their distances, its slopes by differences, and
its factors by known ones.
"""

import math

import numpy as np
import pytest

from characterize.model import kernel
from characterize.model.glass import FilmStack
from characterize.model.kernel import CompressedKernel
from metalens.core.errors import FitError

K, NOMINAL, AWAY, TANGENTS = 2 * math.pi / 0.83, 31.0, 33.7, (0.21, -0.13)
KERNEL = CompressedKernel(K, (-0.31, 0.12), (-0.05, 0.27), NOMINAL, AWAY, TANGENTS)
P, Q = np.array([-0.3, 0.02, 0.11]), np.array([0.26, -0.04, 0.1])
X, Y = np.array([[2.3], [-1.7]]), np.array([[-0.9], [3.1]])


def distance(p, q, x, y, this=KERNEL, far=AWAY):
    """From the lens's point that is seen in these directions at the nominal distance to
    a point of the window.
    """
    r_0 = (this.nodes_um or NOMINAL) / np.sqrt(1 - p**2 - q**2)
    lens = NOMINAL * TANGENTS[0] + r_0 * p, NOMINAL * TANGENTS[1] + r_0 * q
    return np.sqrt(
        (far * TANGENTS[0] + x - lens[0]) ** 2
        + (far * TANGENTS[1] + y - lens[1]) ** 2
        + far**2
    )


def test_paths_are_differences_of_distances_to_the_window_and_its_middle():
    for this in (
        KERNEL,
        CompressedKernel(K, KERNEL.p, KERNEL.q, NOMINAL, AWAY, TANGENTS, nodes_um=28.0),
    ):
        path, ray = this.path(P, Q, X, Y)
        assert ray == pytest.approx(distance(P, Q, X, Y, this), rel=1e-13)
        assert path == pytest.approx(
            distance(P, Q, X, Y, this) - distance(P, Q, 0.0, 0.0, this), abs=1e-12
        )
    size, r = KERNEL.amplitude(ray)
    assert r is ray
    assert size == pytest.approx(AWAY / (2 * math.pi * ray**2), rel=1e-13)


def snell(far):
    """Optical path through 15 um of 1.1, 9 of 1.52 and 7 of 1.33 to a point so far
    aside, by bisection of the sine.
    """
    media, low, high = ((1.1, 15.0), (1.52, 9.0), (1.33, 7.0)), 0.0, 1.1
    for _ in range(80):
        sine = (low + high) / 2
        gone = sum(t * sine / math.sqrt(n * n - sine * sine) for n, t in media)
        low, high = (sine, high) if gone < far else (low, sine)
    return sum(n * n * t / math.sqrt(n * n - low * low) for n, t in media)


def test_paths_through_films_are_those_of_snells_rays():
    """At the nominal 31 um; the chord's table of rays is good to 1e-9 of them."""
    films = FilmStack((), ((1.52, 9.0), (1.33, 7.0)), 1.1)
    this = CompressedKernel(K, KERNEL.p, KERNEL.q, NOMINAL, NOMINAL, TANGENTS, films)
    path, ray = this.path(P, Q, X, Y)
    r_0 = NOMINAL / np.sqrt(1 - P**2 - Q**2)
    near = np.hypot(r_0 * P, r_0 * Q)
    far = np.hypot(X - r_0 * P, Y - r_0 * Q)
    assert ray == pytest.approx(far**2, rel=1e-12)
    want = np.array(
        [[snell(far[i, j]) - snell(near[j]) for j in range(3)] for i in range(2)]
    )
    assert path == pytest.approx(want, abs=1e-6)
    _, r = this.amplitude(ray)
    assert r == pytest.approx(
        np.array([[snell(one) for one in row] for row in far]), abs=1e-6
    )


def test_factors_of_each_axis_are_paths_along_the_middle_of_the_other():
    """(a, b) = (-0.095, 0.11); farther away by 1.3 um too. The window has what both
    leave of the middle's own path.
    """
    a, b = -0.095, 0.11
    for off in (0.0, 1.3):
        along = KERNEL.by_x(P, X, off), KERNEL.by_y(Q, Y, off)
        far = AWAY + off
        assert along[0] == pytest.approx(
            distance(P, b, X, 0, far=far) - distance(P, b, 0, 0, far=far), abs=1e-12
        )
        assert along[1] == pytest.approx(
            distance(a, Q, 0, Y, far=far) - distance(a, Q, 0, 0, far=far), abs=1e-12
        )
    middle = distance(a, b, 0.0, 0.0)
    bent = distance(a, b, X, Y) - distance(a, b, X, 0) - distance(a, b, 0, Y) + middle
    assert KERNEL.window(X, Y) == pytest.approx(np.exp(1j * K * bent), abs=1e-11)
    rest = KERNEL.rest(P, Q, X, Y, np.complex128)
    r = distance(P, Q, X, Y)
    want = (
        AWAY
        / (2 * math.pi * r**2)
        * (1 / r - 1j * K)
        * np.exp(1j * K * (r - distance(P, Q, 0.0, 0.0)))
    )
    factors = np.exp(1j * K * (KERNEL.by_x(P, X) + KERNEL.by_y(Q, Y))) * KERNEL.window(
        X, Y
    )
    assert rest * factors == pytest.approx(want, rel=1e-10)
    assert KERNEL.rest(P, Q, X, Y).dtype == np.complex64


def test_slopes_are_those_of_paths_less_those_of_the_middle_direction_on_its_axis():
    step, a, b = 1e-4, -0.095, 0.11
    got = KERNEL.turning(P, Q, X, Y)
    for axis, (dx, dy) in enumerate(((step, 0.0), (0.0, step))):
        here = (distance(P, Q, X + dx, Y + dy) - distance(P, Q, X - dx, Y - dy)) / (
            2 * step
        )
        on = (X, 0 * Y) if axis == 0 else (0 * X, Y)
        carrier = (
            distance(a, b, on[0] + dx, on[1] + dy)
            - distance(a, b, on[0] - dx, on[1] - dy)
        ) / (2 * step)
        assert got[axis] == pytest.approx(here - carrier, abs=1e-8)


def test_bands_are_the_largest_slopes_over_the_window_and_the_lens():
    """At nine places of each coordinate, both ends among them: along y first."""
    t = np.linspace(-1, 1, 9)
    p, q = -0.095 + 0.215 * t, 0.11 + 0.16 * t
    most = [0.0, 0.0]
    for x in 2.6 * t:
        for y in 1.4 * t:
            by_x, by_y = KERNEL.turning(p[:, None], q, np.array([[x]]), np.array([[y]]))
            most = [max(most[0], np.abs(by_y).max()), max(most[1], np.abs(by_x).max())]
    assert KERNEL.bands(1.4, 2.6) == pytest.approx(
        (K * most[0], K * most[1]), rel=1e-12
    )


def test_a_longer_distance_or_wave_is_longer_by_its_share():
    assert KERNEL.moved("distance", 0.02).distance_um == pytest.approx(AWAY * 1.02)
    assert KERNEL.moved("distance", 0.02).k == K
    assert KERNEL.moved("wave", 0.02).k == pytest.approx(2 * math.pi / (0.83 * 1.02))
    assert KERNEL.moved("wave", 0.02).distance_um == AWAY


@pytest.mark.parametrize("kind", [np.complex64, np.complex128])
def test_turns_are_wrapped_before_they_lose_digits(kind):
    """1e5 turns and a bit: single precision of the phase itself would leave 0.03 rad."""
    phase = 2 * math.pi * (1e5 + np.array([0.13, -0.41, 0.5])) + 0.0
    found = kernel.wrapped_phasors(phase, kind)
    assert found.dtype == kind
    assert found == pytest.approx(
        np.exp(1j * 2 * math.pi * np.array([0.13, -0.41, 0.5])), abs=1e-6
    )
    faded = kernel.wrapped_phasors(np.array([0.3 + 0.7j]), kind)
    assert faded == pytest.approx(
        [math.exp(-0.7) * (math.cos(0.3) + 1j * math.sin(0.3))], rel=1e-6
    )
    assert faded.dtype == kind


def test_precision_follows_the_tolerance():
    assert [kernel.complex_precision(t) for t in (0.5, 1e-4)] == [np.complex64] * 2
    assert [kernel.complex_precision(t) for t in (0.99e-4, 1e-9)] == [np.complex128] * 2
    for wrong in (0.99e-9, 1.0, math.nan):
        with pytest.raises(FitError, match="need 1e-9 to 1"):
            kernel.complex_precision(wrong)
    assert (kernel.real_of(np.complex64), kernel.real_of(np.complex128)) == (
        np.float32,
        np.float64,
    )
    assert kernel.extra_digits(5e-4) == kernel.extra_digits(0.1) == 0.0
    assert kernel.extra_digits(5e-6) == pytest.approx(math.log(100))
    eps = np.finfo(np.float32).eps
    for shape in ((3, 400), (400, 3)):
        assert kernel.least_tolerance(np.zeros(shape, np.complex64)) == pytest.approx(
            5 * eps * 20
        )


def known(sizes, shape=(61, 47), seed=3):
    """A table with these singular values."""
    rng = np.random.default_rng(seed)
    left, right = (
        np.linalg.qr(
            rng.normal(size=(n, len(sizes))) + 1j * rng.normal(size=(n, len(sizes)))
        )[0]
        for n in shape
    )
    return left * sizes @ right.conj().T


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e4])
@pytest.mark.parametrize("tolerance", [0.3, 1e-2, 1e-5, 1e-9])
def test_factors_have_as_many_terms_as_their_remainder_needs(tolerance, scale):
    """Singular values that halve: what is left before term n is 2^-n of the norm; more
    than two blocks of columns.
    """
    sizes = scale * 0.5 ** np.arange(46)
    table = known(sizes)
    columns, rows, remainder = kernel.low_rank_factors(table, tolerance)
    rank = next(
        n
        for n in range(46)
        if math.sqrt((sizes[n:] ** 2).sum() / (sizes**2).sum()) <= tolerance
    )
    assert (columns.shape, rows.shape) == ((61, rank), (rank, 47))
    # what the search leaves is a fifth of the tolerance: 2 % of the last, as squares
    assert remainder == pytest.approx(0.5 ** np.arange(rank), rel=0.04)
    assert np.linalg.norm(table - columns @ rows) <= tolerance * np.linalg.norm(table)
    assert columns.conj().T @ columns == pytest.approx(np.eye(rank), abs=1e-9)


def test_factors_of_one_term_and_of_more_than_is_held():
    columns, rows, remainder = kernel.low_rank_factors(known(np.array([3.0])), 1e-6)
    assert (len(rows), remainder) == (1, pytest.approx([1.0]))
    assert columns @ rows == pytest.approx(known(np.array([3.0])), abs=1e-9)
    assert len(kernel.low_rank_factors(known(np.array([3.0, 1e-3])), 0.9)[1]) == 1
    with pytest.raises(FitError, match="complex64 tables of"):
        kernel.low_rank_factors(known(np.array([3.0, 1.0])).astype(np.complex64), 4e-6)
    assert (
        len(
            kernel.low_rank_factors(
                known(np.array([3.0, 1.0])).astype(np.complex64), 1e-5
            )[1]
        )
        == 2
    )


@pytest.mark.parametrize("slope", [0.0, 3.0, 7.7, 40.0])
def test_terms_of_a_wave_leave_a_fiftieth_of_the_tolerance(slope):
    """exp(i s t) by its Legendre coefficients, from a quadrature: one term fewer would
    leave more.
    """
    t, weights = np.polynomial.legendre.leggauss(300)
    wave = np.exp(1j * slope * t)
    orders = np.arange(140)
    values = np.polynomial.legendre.legvander(t, 139)
    size = (
        np.abs((weights * wave) @ values) ** 2 * (2 * orders + 1) / 4
    )  # of mean square 1 together
    for tolerance in np.geomspace(1e-2, 1e-7, 23):
        left = np.sqrt(np.cumsum(size[::-1])[::-1])
        assert kernel._terms(slope, tolerance) == 1 + int((left > tolerance / 50).sum())
        assert left[kernel._terms(slope, tolerance)] <= tolerance / 50


@pytest.mark.parametrize(
    ("half", "span", "tolerance", "window", "aperture"),
    [
        (
            0.3,
            (-0.01, 0.01),
            5e-4,
            12,
            10,
        ),  # a narrow lens and a small window: the least of both
        (0.3, (0.2, 0.22), 5e-4, 12, 13),  # 10 + 16 of the largest cosine
        (
            0.3,
            (0.2, 0.22),
            5e-6,
            12,
            21,
        ),  # a hundred times as fine: 1 + ln(100) / 8 of that
        (31.0, (-0.01, 0.01), 5e-4, 16, 10),  # as wide as far: 14 over asinh(1)
        (31.0, (-0.01, 0.01), 5e-6, 22, 10),
    ],
)
def test_counts_of_nodes_hold_branches_and_digits(
    half, span, tolerance, window, aperture
):
    this = CompressedKernel(
        1e-6, span, (0.0, 0.005), 31.0, 31.0
    )  # waves so long that no phase turns
    assert this.counts(half, half / 3, tolerance) == (
        window,
        aperture
        if aperture > 10
        else int(10.16 * (1 + kernel.extra_digits(tolerance) / 8)),
    )


def test_counts_of_nodes_follow_the_steepest_phases():
    """Half a span's phases of the rest, at nine places of each coordinate, window and
    lens apart.
    """
    t = np.linspace(-1, 1, 9)
    y, x, q, p = np.meshgrid(
        12.1 * t, 21.3 * t, 0.11 + 0.16 * t, -0.095 + 0.215 * t, indexing="ij"
    )
    left = distance(p, q, x, y) - distance(p, q, 0, 0)
    left = left - KERNEL.by_x(p, x) - KERNEL.by_y(q, y)
    left = left - (
        KERNEL.path(-0.095, 0.11, x, y)[0]
        - KERNEL.by_x(-0.095, x)
        - KERNEL.by_y(0.11, y)
    )
    steep = [K * np.abs(np.diff(left, axis=axis)).max() / 0.25 for axis in range(4)]
    branch = 1 / math.asinh(AWAY / 21.3)
    window = math.ceil(kernel._terms(max(steep[:2]), 5e-4) + 6 * branch)
    got = KERNEL.counts(12.1, 21.3)
    assert got == (
        max(12, window),
        max(int(10 + 16 * 0.31), kernel._terms(max(steep[2:]), 5e-4)),
    )
    assert got[0] > 12
