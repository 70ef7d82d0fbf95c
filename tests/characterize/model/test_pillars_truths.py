"""Low-rank pillars and coarse windows against what they stand for: polynomials, exact
answers, integrals.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from scipy.interpolate import CubicSpline

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[2] / "referees"))
import bench_lens as b
import hidden_lens

from characterize.model import parameters, window
from characterize.model import pillars as model
from characterize.model.pillars import PillarChange, PillarResponse
from characterize.model.window import AxisOperators, CouplingTerms, WindowOperators

RNG = np.random.default_rng(61)


@pytest.fixture(scope="module")
def pillars():
    return PillarResponse(b.lens(), b.RESPONSE)


def test_weights_are_chebyshev_polynomials_of_the_bias_and_their_slopes_per_micrometre(
    pillars,
):
    bias = np.array([[0.011, -0.024], [0.0, 0.0299]])
    value = pillars.weights(bias)
    slope = pillars.rates(bias, value)
    for n in range(len(value)):
        series = np.eye(n + 1)[n]
        x = bias / pillars.span.bias_um
        assert value[n] == pytest.approx(chebyshev.chebval(x, series), abs=1e-9)
        rate = chebyshev.chebval(x, chebyshev.chebder(series)) if n else 0 * x
        assert slope[n] == pytest.approx(
            rate / pillars.span.bias_um, rel=1e-9, abs=1e-9
        )


def some_change(share=0.6):
    span = model.ChangeRange()
    return PillarChange(
        tuple(share * RNG.uniform(-1, 1, len(span.answers)) * span.answers), 0.0
    )


def low_rank(pillars, bias, change):
    return pillars.basis.conj().T @ (
        pillars.weights(np.array(bias)) @ pillars.coefficients(change)
    )


def test_the_error_is_that_of_other_random_changes(pillars):
    """Forty of its own; thirty others are off by no more than twice as much, and by
    more than a tenth of it.
    """
    off = []
    for _ in range(30):
        change, bias = some_change(0.7), RNG.uniform(-0.7, 0.7) * 0.03
        off.append(
            np.abs(low_rank(pillars, bias, change) - pillars.exact(bias, change)).max()
        )
    assert 0.1 * pillars.error < max(off) < 2 * pillars.error
    assert pillars.error < 2e-3


@pytest.mark.parametrize(
    ("missed", "laid"), [((1.9e-3,), 1), ((2.1e-3, 1.9e-3), 2), ((1.0, 0.5, 0.2), 3)]
)
def test_nodes_are_laid_twice_and_thrice_as_densely_where_two_thousandths_of_t_are_missed(
    monkeypatch, missed, laid
):
    """The last is told in any case."""
    left, counts = list(missed), []
    lay = PillarResponse._lay
    monkeypatch.setattr(
        PillarResponse,
        "_lay",
        lambda self, count, tolerance: counts.append(count) or lay(self, 7, 1e-2),
    )
    monkeypatch.setattr(PillarResponse, "_measure", lambda self: left.pop(0))
    found = PillarResponse(b.lens(), b.RESPONSE)
    assert counts == [counts[0] * times - (times - 1) for times in range(1, laid + 1)]
    assert found.error == missed[-1]


def test_slopes_by_the_answering_causes_are_differences_of_the_coefficients(pillars):
    change = some_change()
    slopes = pillars.slopes(change)
    for i in range(len(slopes)):
        h = 1e-4 * model.ChangeRange().answers[i]
        ends = []
        for sign in (1, -1):
            moved = list(change.answers)
            moved[i] += sign * h
            ends.append(pillars.coefficients(PillarChange(tuple(moved), 0.0)))
        want = (ends[0] - ends[1]) / (2 * h)
        assert slopes[i] == pytest.approx(want, abs=1e-5 * np.abs(want).max())


def test_entries_of_the_table_are_the_nearest_diameters_and_none_is_the_last(pillars):
    low, high = pillars.diameter_um[[0, -1]]
    step = (high - low) / 20000
    at = np.array([low, low + 0.4 * step, low + 0.6 * step, high, 0.0])
    assert pillars.place(at).tolist() == [0, 0, 1, 20000, 20001]
    table = pillars.table()
    assert table.shape == (len(pillars.basis), 20002)
    assert np.abs(table[:, -1]).max() == 0
    places = [0, 7 * 20000 // 192, 20000]
    for p in places:
        d = low + p * step
        want = [
            CubicSpline(pillars.diameter_um, row.conj())(d) for row in pillars.basis
        ]
        assert table[:, p] == pytest.approx(
            np.array(want), abs=2e-4 * np.abs(pillars.basis).max()
        )


def test_a_cubic_between_samples_is_exact_for_cubics_from_end_to_end():
    def of(x):
        return 3 - 0.7 * x + 0.21 * x**2 - 0.013 * x**3

    place = np.array([0.0, 0.4, 1.0, 1.3, 4.77, 6.0, 7.2, 8.0])
    assert model._cubic(of(np.arange(9.0)), place) == pytest.approx(
        of(place), rel=1e-12
    )


def test_light_meets_pillars_at_the_angle_of_its_slopes_where_the_proxy_knows_angles():
    for most, want in (
        (0.3, math.atan(math.hypot(math.tan(0.2), math.tan(-0.11)))),
        (0.0, 0.0),
    ):
        assert model.incidence_rad(
            SimpleNamespace(max_angle_rad=most), (0.2, -0.11)
        ) == pytest.approx(want)


def test_changes_are_in_micrometres_and_in_base_units():
    x = parameters.parameter_vector({"wavelength_nm": 1.7, "height_nm": 12.0})
    change = model.pillar_change_of(x)
    assert change.wavelength_um == pytest.approx(1.7e-3)
    assert sum(abs(a) > 0 for a in change.answers) == 1
    assert max(change.answers) == pytest.approx(12e-3)


def test_interpolation_errs_by_the_rms_over_an_evenly_filled_band():
    """∫ |exp(ikx) - Σ w exp(ikx_j)|² dk / 2B from -B to B by the midpoint rule, at
    every place.
    """
    band, coarse = 2.1, np.arange(14) * (math.pi / 2.1 / 1.3)
    at = np.linspace(3.2, 12.9, 17)
    weights, missed = window._weights(at, coarse, band, 8)
    assert ((weights != 0).sum(1) <= 8).all()
    k = band * (2 * (np.arange(4000) + 0.5) / 4000 - 1)
    off = np.exp(1j * np.outer(at, k)) - weights @ np.exp(1j * np.outer(coarse, k))
    assert missed == pytest.approx(np.sqrt((np.abs(off) ** 2).mean(1)), rel=1e-3)
    nudged = weights + 1e-4 * RNG.normal(size=weights.shape) * (
        weights != 0
    )  # the least of all weights
    worse = np.exp(1j * np.outer(at, k)) - nudged @ np.exp(1j * np.outer(coarse, k))
    assert ((np.abs(worse) ** 2).mean(1) > (np.abs(off) ** 2).mean(1)).all()


def terms(size=1.0):
    across, amounts = RNG.normal(size=(3, 6)), RNG.normal(size=(5, 4, 3))
    inside = RNG.normal(size=(7, 4, 8))
    remainder, mixed = np.array([1.0, 0.3, 0.04, 0.006]), np.array([1.0, 0.009, 0.0007])
    return CouplingTerms(across, amounts, inside, remainder, mixed, size)


def way(fine, coarse, nodes):
    parts = [
        RNG.normal(size=shape)
        for shape in ((coarse, nodes), (fine, coarse), (coarse, nodes), (coarse, nodes))
    ]
    return AxisOperators(
        parts[0] + 0j,
        parts[1],
        np.exp(1j * RNG.normal(size=fine)),
        {"wave": parts[2], "distance": parts[3]}.__getitem__,
    )


def plain(light, y, x, some):
    """Σ W_r(Y, X) Fy(Y, q) a_rb(q) L(q, p) g_b(p) Fx(X, p)."""
    across, amounts, inside = some
    return np.einsum(
        "YrX,Yq,qrb,qp,bp,Xp->YX", inside, y, amounts, light, across, x, optimize=True
    )


def test_terms_are_left_out_by_what_is_behind_them():
    one = terms()
    assert [part.shape for part in one.some(0.03)] == [
        (1, 6),
        (5, 3, 1),
        (7, 3, 8),
    ]  # 0.04 > 0.03; 0.009 < 0.015
    assert [part.shape for part in one.some(0.017)] == [
        (2, 6),
        (5, 3, 2),
        (7, 3, 8),
    ]  # 0.04 > 0.017; 0.009 > 0.0085
    assert [part.shape for part in one.some(0.3)] == [(1, 6), (5, 1, 1), (7, 1, 8)]
    assert [part.shape for part in one.some(0.0)] == [(3, 6), (5, 4, 3), (7, 4, 8)]


def test_fields_and_their_rates_are_sums_over_both_axes_and_the_terms():
    """The rate by the distance is that of either axis and of the rest; each with terms
    left out by its share of the
    tolerance: of the hypotenuse of all sizes over √3, over its own, at most a fifth."""
    y, x, rest, moved = way(9, 7, 5), way(11, 8, 6), terms(), terms(2.6)
    made = WindowOperators(y, x, rest, lambda name: moved)
    light = RNG.normal(size=(2, 5, 6))
    got = made.field(light, 0.03)
    for i in (0, 1):
        want = y.fine @ plain(light[i], y.to, x.to, rest.some(0.03)) @ x.fine.T
        assert got[i] == pytest.approx(
            want * (y.carrier[:, None] * x.carrier), rel=1e-9
        )
    sizes = [
        np.linalg.norm(w.moved("distance")) / np.linalg.norm(w.to) for w in (y, x)
    ] + [2.6]
    whole = 0.05 * math.sqrt(sum(s * s for s in sizes) + 1.7**2) / math.sqrt(3)
    shares = [min(whole / s, 0.2) for s in sizes]
    rates = made.rates(light, "distance", 0.05, beside=1.7)
    want = plain(light[1], y.moved("distance"), x.to, rest.some(shares[0]))
    want = want + plain(light[1], y.to, x.moved("distance"), rest.some(shares[1]))
    want = want + plain(light[1], y.to, x.to, moved.some(shares[2]))
    assert rates[1] == pytest.approx(y.fine @ want @ x.fine.T, rel=1e-9)


def test_between_wavelengths_pillars_are_those_of_the_proxy():
    """A fraction of a radian over the span, which twelve nodes hold to rounding, but
    where |t| is held at 1: a kink of
    1e-3 in a hundredth of all pillars. Beyond the span the proxy is asked itself."""
    lens = hidden_lens.lens()
    found = PillarResponse(lens, b.RESPONSE)
    for off, close in ((-0.0041, 1e-8), (0.00587, 1e-8), (0.0073, 1e-15)):
        want = model.designed(
            lens.proxy,
            found.diameter_um + found.nodes_um[:, None],
            lens.wavelength_um + off,
        )
        error = np.abs(found._at_nodes(PillarChange(wavelength_um=off)) - want)
        assert (error > close).mean() < 0.02
        assert error.max() < 1e-3


def test_what_nobody_states_is_reckoned_with_as_plausible_or_as_its_prior_has_it():
    """A plate of glass is free in its prior and 0.1 mm where nobody speaks of it; a
    tilt has its prior alone.
    """
    told = {p.name: p for p in parameters.PARAMETERS}
    assert (told["glass_um"].sigma, told["glass_um"].unstated) == (math.inf, 100.0)
    assert (told["light_x"].sigma, told["light_x"].unstated) == (0.3, 0.2)
    assert (told["bandwidth_nm"].sigma, told["bandwidth_nm"].unstated) == (
        math.inf,
        1.0,
    )
    assert told["tilt_x_deg"].unstated == told["tilt_x_deg"].sigma == 1.0
