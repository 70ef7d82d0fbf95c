"""Terms of a PSF's error added as they should be, and the model's own terms by plain
quadrature.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy import integrate, special

from metalens.lens import NeighbourRows
from metalens.psf import budget
from metalens.psf.budget import Budget

NAN = math.nan


def test_terms_add_as_squares_and_unknown_ones_not_at_all():
    one = Budget(
        0.02,
        0.03,
        0.06,
        polarisation=0.1,
        angle=0.2,
        glass=NAN,
        neighbours=0.2,
        outside=0.5,
    )
    assert one.computed == pytest.approx(0.07, rel=1e-12)
    assert one.model == pytest.approx(0.3, rel=1e-12)
    assert one.total == pytest.approx(math.hypot(0.07, 0.3), rel=1e-12)
    assert Budget(0.02).model == 0
    assert Budget(0.02).total == 0.02
    assert dataclasses.replace(one, glass=0.4).model == pytest.approx(0.5, rel=1e-12)


def test_the_worst_budget_takes_the_largest_of_every_term():
    made = budget.worst_of_budgets(
        [
            Budget(0.2, 0.01, angle=0.5),
            Budget(0.1, 0.04, 0.3, glass=0.2),
            Budget(0.15, angle=0.1),
        ]
    )
    assert (made.numerical, made.sampling, made.spectrum, made.angle, made.glass) == (
        0.2,
        0.04,
        0.3,
        0.5,
        0.2,
    )
    assert math.isnan(made.polarisation)


def test_the_line_for_a_person_names_what_is_known():
    words = Budget(0.02, outside=0.123).text
    assert words.startswith(
        "error by cause: numerical 2.0e-02, sampling 0, spectrum 0, source 0; of"
    )
    assert words.endswith("; 12.3% of the light falls beside the window")
    assert "glass" not in words


def radial(aperture, at, bessel, of):
    """Integral over the sines of a perfect lens, by adaptive quadrature."""
    return integrate.quad(
        lambda p: of(p) * special.jv(bessel, p * at) * p, 0, aperture, limit=400
    )[0]


def apart(one, other, radius):
    """Relative L2 distance of two radial PSFs of sum 1 over the plane."""
    one, other = one / (one @ radius), other / (other @ radius)
    return math.sqrt((one - other) ** 2 @ radius / (other**2 @ radius))


NODE, WEIGHT = np.polynomial.legendre.leggauss(200)


def airy(aperture, factor=lambda p: 1.0 + 0j):
    """(radius in 1/k, |U|²) of a perfect lens with a factor on its light."""
    p, radius = aperture * (NODE + 1) / 2, np.linspace(0, 30 / aperture, 240)
    return radius, np.abs(
        (WEIGHT * p / (1 - p * p) * factor(p)) @ special.jv(0, np.outer(p, radius))
    ) ** 2


def test_the_models_own_terms_are_integrals_over_the_aperture():
    """1 / (1 - p²) dp² is the solid angle twice over; flux: I0² - I2², √cos θ (1 ± cos
    θ), of Richards and Wolf.
    """
    aperture = 0.61
    radius = np.linspace(0, 30 / aperture, 240)

    def cosine(p):
        return math.sqrt(1 - p * p)

    def factor(p):
        return 1 + (0.057 - 0.289j) * p + (-0.523 + 0.054j) * p * p

    plain = np.array(
        [radial(aperture, r, 0, lambda p: 1 / (1 - p * p)) for r in radius]
    )
    crowd = np.array(
        [
            complex(
                radial(aperture, r, 0, lambda p: factor(p).real / (1 - p * p)),
                radial(aperture, r, 0, lambda p: factor(p).imag / (1 - p * p)),
            )
            for r in radius
        ]
    )
    parts = [
        np.array(
            [
                radial(
                    aperture,
                    r,
                    n,
                    lambda p, of=of: of(p) / (1 - p * p) / math.sqrt(cosine(p)),
                )
                for r in radius
            ]
        )
        for n, of in ((0, lambda p: 1 + cosine(p)), (2, lambda p: 1 - cosine(p)))
    ]
    flux = parts[0] ** 2 - parts[1] ** 2
    want = apart(plain**2, flux, radius)
    assert budget.scalar_error(aperture) == pytest.approx(want, rel=1e-6)
    assert budget.scalar_error(aperture, 0.3) == pytest.approx(
        math.hypot(want, 0.045), rel=1e-6
    )
    made = budget.with_model(
        Budget(0.01),
        aperture=aperture,
        polarisation="scalar",
        incidence_rad=0.2,
        has_angles=False,
        ghost=0.07,
        uneven=0.04,
    )
    assert made.polarisation == pytest.approx(math.hypot(want, 8e-4), rel=1e-6)
    assert made.neighbours == pytest.approx(
        apart(np.abs(crowd) ** 2, plain**2, radius), rel=1e-6
    )
    assert made.angle == pytest.approx(2.5 * math.sin(0.2) ** 2, rel=1e-12)
    assert (made.glass, made.numerical) == (0.07, 0.01)
    exact = budget.with_model(
        Budget(0.01, polarisation=0.003),  # measured on both
        aperture=aperture,
        polarisation="vector",
        incidence_rad=0.9,
        has_angles=True,
        ghost=0.0,
    )
    assert (exact.polarisation, exact.angle) == (0.003, 0.0)
    wide = budget.with_model(
        Budget(0.01),
        aperture=0.1,
        polarisation="vector",
        incidence_rad=1.2,
        has_angles=False,
        ghost=0.0,
    )
    assert wide.angle == 1.0


def test_light_unlike_that_of_the_rows_has_its_own_terms_with_the_factor_of_unlike_neighbours():
    """One row, alike for both fields and truncations: left are zones that get shorter
    (a fifth of the change), light
    from the side (2.5 sin² of it) and, for each wavelength, a factor that goes with the
    sine in place of the zones."""
    aperture, factor = 0.5, np.full((2, 1), 0.8 + 0.1j)
    known = NeighbourRows(
        np.array([0.6]), np.zeros(1, bool), factor, factor, np.zeros(1), 0.85
    )
    radius = np.linspace(0, 30 / aperture, 240)

    def light(scale):
        return airy(aperture, lambda p: known.mean(scale * p))[1]

    def left(**more):
        given = (
            dict(
                aperture=aperture,
                polarisation="flux",
                has_angles=True,
                ghost=0.0,
                incidence_rad=0.0,
            )
            | more
        )
        return budget.with_model(
            Budget(0.0), **given, left_out=budget.LeftOut(known)
        ).neighbours

    change = apart(light(0.0), light(1.0), radius)
    assert left() == pytest.approx(0.2 * change, rel=1e-6)
    assert left(light=(np.array([0.85]), np.ones(1))) == pytest.approx(
        0.2 * change, rel=1e-6
    )
    side = math.hypot(0.2, 2.5 * math.sin(0.3) ** 2) * change
    assert left(incidence_rad=0.3) == pytest.approx(side, rel=1e-6)
    far = [apart(light(w / 0.85), light(1.0), radius) for w in (0.7, 0.8)]
    want = math.sqrt((0.2 * change) ** 2 + 0.4 * far[0] ** 2 + 0.6 * far[1] ** 2)
    assert left(light=(np.array([0.7, 0.8]), np.array([0.4, 0.6]))) == pytest.approx(
        want, rel=1e-6
    )
    assert (
        "1 solved rows at 0.85 um and normal incidence" in budget.LeftOut(known).words
    )


def test_the_scalar_leaves_out_that_fields_along_and_across_the_slope_are_told_apart():
    """J = mean + half the difference times (cos 2φ, sin 2φ): light of the second turns
    twice about the axis, J2, and
    adds to that of the first. A row along the lattice, one along its diagonal, whose
    absence counts beside it."""
    aperture = 0.5
    factor = np.array([[0.8 + 0.1j, 0.85 - 0.2j], [1.5 - 0.5j, 1.3 + 0.4j]])
    known = NeighbourRows(
        np.array([0.6, 0.55]),
        np.array([False, True]),
        factor,
        factor,
        np.zeros(2),
        0.85,
    )
    radius = np.linspace(0, 30 / aperture, 240)

    node, weight = np.polynomial.legendre.leggauss(200)
    p = aperture * (node + 1) / 2

    def light(of, order=0):
        return (
            np.abs(
                (weight * p / (1 - p * p) * of(p))
                @ special.jv(order, np.outer(p, radius))
            )
            ** 2
        )

    def difference(p):
        along, across = (
            known.at(p, 0.0) + known.at(p, math.pi / 4)
        ) / 2  # the mean over azimuths
        return (along - across) / 2

    mean, plain = light(known.mean), light(lambda p: 1.0 + 0j)
    (other,) = known.others
    left = apart(light(other.mean), mean, radius) + 0.2 * apart(plain, mean, radius)
    about = dict(
        aperture=aperture,
        has_angles=True,
        ghost=0.0,
        incidence_rad=0.0,
        left_out=budget.LeftOut(known),
    )
    flux = budget.with_model(Budget(0.0), polarisation="flux", **about)
    assert flux.neighbours == pytest.approx(left, rel=1e-6)
    scalar = budget.with_model(Budget(0.0), polarisation="scalar", **about)
    aside = apart(mean + light(difference, 2), mean, radius)
    assert scalar.neighbours == pytest.approx(math.hypot(left, aside), rel=1e-6)
    assert aside > 0.1 * left  # it counts


def test_light_that_neighbours_scatter_meets_the_focus_in_any_phase():
    """Speckle of the power that C takes from the focus, drawn over the shadow of the
    lens: its beat with the PSF.
    """
    aperture, lit, step, factor = 0.4, 900.0, 0.2, 0.9
    known = NeighbourRows(
        np.array([0.5]),
        np.zeros(1, bool),
        *2 * [np.full((2, 1), factor + 0j)],
        np.zeros(1),
        0.85,
    )
    given = dict(
        aperture=aperture,
        polarisation="flux",
        has_angles=True,
        ghost=0.0,
        incidence_rad=0.0,
    )
    found, endless = (
        budget.with_model(
            Budget(0.0), **given, left_out=budget.LeftOut(known), lit=area
        ).neighbours
        for area in (lit, math.inf)
    )
    kept = _power_kept(known, aperture)
    side = np.arange(-5, 5, step)  # wavelengths: 20 rings
    across = np.hypot(*np.meshgrid(side, side)).ravel()
    radii = np.linspace(0, across.max(), 400)
    profile = [
        radial(aperture, 2 * math.pi * r, 0, lambda p: 1 / (1 - p * p)) for r in radii
    ]
    light = np.interp(across, radii, profile)
    light *= math.sqrt(kept / (light @ light * step**2))
    draw = np.random.default_rng(5).normal(size=(2, 400, len(light)))
    speckle = (draw[0] + 1j * draw[1]) * math.sqrt((1 - kept) / lit / 2)
    beat = 2 * (light * speckle).real
    want = math.sqrt((beat**2).sum(1).mean() / (light**4).sum())
    assert math.sqrt(found**2 - endless**2) == pytest.approx(
        want, rel=0.05
    )  # light beyond 5 wavelengths; 400 draws


def _power_kept(known, aperture):
    """Mean of |C|² over the light of a perfect lens: r dr = f² p dp / (1 - p²)²."""
    power = [
        integrate.quad(lambda p, of=of: of(p) * p / (1 - p * p) ** 2, 0, aperture)[0]
        for of in (lambda p: float(abs(known.mean(p)) ** 2), lambda p: 1.0)
    ]
    return power[0] / power[1]


def test_scattered_light_counts_beside_rough_neighbours_too():
    """Squares add: 2 <|n|²> ∫|U|² over ∫|U|⁴, <|n|²> the lost power over the area; that of |1 + a s + b s²|²."""
    aperture, lit, rough = (
        0.55,
        700.0,
        budget.LeftOut((0.05 - 0.3j, -0.4 + 0.1j), of="made up"),
    )
    given = dict(
        aperture=aperture,
        polarisation="flux",
        has_angles=True,
        ghost=0.0,
        incidence_rad=0.0,
        left_out=rough,
    )
    found, endless = (
        budget.with_model(Budget(0.0), **given, lit=area).neighbours
        for area in (lit, math.inf)
    )

    def factor(p):
        return 1 + (0.05 - 0.3j) * p + (-0.4 + 0.1j) * p * p

    assert endless == pytest.approx(
        apart(airy(aperture, factor)[1], airy(aperture)[1], airy(aperture)[0]), rel=1e-6
    )
    p = aperture * (NODE + 1) / 2
    power = WEIGHT * p / (1 - p * p) ** 2
    kept = float(power @ np.abs(factor(p)) ** 2 / power.sum())
    radius, light = airy(aperture, factor)
    ring = (
        2 * math.pi * radius * (radius[1] - radius[0]) / (2 * math.pi) ** 2
    )  # squared wavelengths
    want = 2 * (1 - kept) / kept / lit * (light @ ring) ** 2 / (light**2 @ ring)
    assert found**2 - endless**2 == pytest.approx(want, rel=1e-6)
    assert want > 0.05 * endless**2


def test_pillars_off_their_curve_send_light_across_the_focus_in_step_with_it():
    """2 √(2 (∫I)² / ∫I² / area) of an Airy disc, (2 J1(v)/v)² with v = 2π a ρ in
    wavelengths, as far as v = 30; at
    most the 2 of an amplitude that is off everywhere."""
    aperture, lit, off = 0.06, 70_000.0, 0.013
    given = dict(
        aperture=aperture,
        polarisation="flux",
        has_angles=True,
        ghost=0.0,
        incidence_rad=0.0,
    )
    area = 2 * math.pi / (2 * math.pi * aperture) ** 2
    power, square = (
        area
        * integrate.quad(
            lambda v, n=n: (2 * special.j1(v) / v) ** (2 * n) * v, 1e-9, 30, limit=200
        )[0]
        for n in (1, 2)
    )
    found = budget.with_model(Budget(0.0), **given, proxy=off, lit=lit).proxy
    assert found == pytest.approx(
        off * 2 * math.sqrt(2 * power**2 / square / lit), rel=3e-3
    )  # cos θ of 1.8e-3
    assert budget.with_model(
        Budget(0.0), **given, proxy=off, lit=0.004 * lit
    ).proxy == pytest.approx(2 * off, rel=1e-12)
    assert math.isnan(budget.with_model(Budget(0.0), **given, lit=lit).proxy)
    assert (
        budget.with_model(Budget(0.0), **given, proxy=off).proxy == 0.0
    )  # of a lens without end


def test_of_rows_left_out_the_one_that_matters_most_counts():
    aperture = 0.5
    factor = np.array(
        [[0.8 + 0.1j, 0.85 - 0.2j, 0.7 + 0.3j], [0.9 - 0.1j, 0.75 + 0.2j, 0.8 - 0.3j]]
    )
    known = NeighbourRows(
        np.array([0.3, 0.45, 0.6]), np.zeros(3, bool), factor, factor, np.zeros(3), 0.85
    )
    radius, mean = airy(aperture, known.mean)
    less = [
        apart(airy(aperture, other.mean)[1], mean, radius) for other in known.others
    ]
    assert len(less) == 3
    assert max(less) > 1.5 * min(less)
    change = apart(airy(aperture)[1], mean, radius)
    made = budget.with_model(
        Budget(0.0), aperture=aperture, polarisation="flux", has_angles=False, ghost=0.0, incidence_rad=0.3,
        left_out=budget.LeftOut(known), light=(np.array([0.8, 0.9]), np.array([0.3, 0.7])),
    )  # fmt: skip
    away = [
        apart(airy(aperture, lambda p, w=w: known.mean(p * w / 0.85))[1], mean, radius)
        for w in (0.8, 0.9)
    ]
    side = math.hypot(0.2, 2.5 * math.sin(0.3) ** 2) * change
    want = math.sqrt((max(less) + side) ** 2 + 0.3 * away[0] ** 2 + 0.7 * away[1] ** 2)
    assert made.neighbours == pytest.approx(
        want, rel=1e-3
    )  # C has kinks at the rows, which nodes step over


def test_words_of_what_is_left_out_say_whose_numbers_they_are():
    rows = NeighbourRows(
        np.array([0.3, 0.6]),
        np.zeros(2, bool),
        *2 * [np.ones((2, 2), complex)],
        np.zeros(2),
        0.94,
    )
    assert "of this cell" in budget.LeftOut((0j, 0j), of="this cell").words
    assert "the default cell, rough (" in budget.LeftOut().words
    assert budget.LeftOut(rows).words.endswith(
        "2 solved rows at 0.94 um and normal incidence; angle: of the default cell, rough"
    )
    assert budget.LeftOut(rows, of="this cell").words.endswith(
        "at 0.94 um and normal incidence"
    )
    assert "beside the window" not in Budget(0.02).text


@pytest.mark.parametrize("cause", ["numerical", "sampling", "spectrum", "source"])
def test_the_cure_is_that_of_the_largest_part_that_is_computed(cause):
    """What the model leaves out is larger here, and no setting of a computation cures
    it.
    """
    parts = {"numerical": 0.02, "sampling": 0.03, "spectrum": 0.025, "source": 0.01} | {
        cause: 0.05
    }
    words = {
        "numerical": "widen the window",
        "sampling": "more samples",
        "spectrum": "narrow the spectrum",
    }
    assert (
        words.get(cause, "smaller source")
        in Budget(**parts, angle=0.4, outside=0.5).cure
    )
