"""Proxy fits on synthetic libraries whose phase and |t| are known functions."""

import dataclasses
import math

import numpy as np
import pytest

from metalens import library, proxy
from metalens.cell.record import Cell, Index
from metalens.cell.shapes import Circle
from metalens.core.errors import DomainError
from metalens.library import fit as proxy_fit
from metalens.library.fit import ProxyTolerances
from metalens.library.record import PillarLibrary, Sweep

CELL = Cell(0.30, 0.7, Index(3.6))
TURN = 2 * math.pi


def phase_of(d, wavelength, angle):
    """1.3 turns from 60 to 220 nm with a bend, chromatic and tilted."""
    x = (d / 0.22) ** 2
    return (
        1.3
        * TURN
        * (x + 0.05 * np.sin(5 * x))
        * (0.85 / wavelength) ** 2
        * (1 + 0.2 * np.sin(angle) ** 2)
    )


def level_of(d, wavelength, angle):
    return 0.93 + 0.0699999 * np.cos(40 * d + wavelength) - 0.1 * np.sin(angle) ** 2


def synthetic(
    waves=(0.85,),
    angles=(0.0,),
    resonances=(),
    factor=None,
    samples=161,
    beside=(),
    bar=1e-4,
) -> PillarLibrary:
    d = np.unique([*np.linspace(0.06, 0.22, samples), *beside])
    w = np.array(waves)[None, :, None]
    a = np.radians(angles)[:, None, None]
    t = level_of(d, w, a) * np.exp(1j * phase_of(d, w, a))
    t = t if factor is None else t * factor(d)
    t = np.stack([t]) if angles == (0.0,) else np.stack([t, t])
    return PillarLibrary(
        cell=CELL,
        sweep=Sweep(waves, angles),
        polarization=("x",) if angles == (0.0,) else ("s", "p"),
        angle_rad=np.radians(angles),
        wavelength_um=np.array(waves),
        diameter_um=d,
        t=t,
        r=0 * t,
        t_error=np.full(t.shape, bar),
        energy=np.abs(t) ** 2,
        resonances=np.array(resonances, float).reshape(-1, 5),
        engine="modal",
        solves=30,
    )


def errors(made, waves, angles, count=500):
    """Largest deviation of phase (modulo a turn) and |T| from the known functions, at
    random places.
    """
    rng = np.random.default_rng(3)
    d = rng.uniform(*made.domain_um, count)
    phase, level = 0.0, 0.0
    for wavelength in waves:
        for angle in angles:
            off = made.phase_rad(d, wavelength, angle) - phase_of(d, wavelength, angle)
            phase = max(phase, abs(off - TURN * np.round(off.mean() / TURN)).max())
            level = max(
                level,
                abs(
                    made.transmission(d, wavelength, angle)
                    - level_of(d, wavelength, angle)
                ).max(),
            )
    return phase, level


def test_the_stated_error_holds_where_the_fit_never_looked():
    made = proxy.fit(synthetic())
    phase, level = errors(made, (0.85,), (0.0,))
    # the polynomial turns between samples by 1/400 of a wave
    assert phase <= 1.05 * made.max_phase_error_rad
    assert level <= 1.05 * made.max_transmission_error
    assert made.max_phase_error_rad <= 1e-3
    assert made.max_transmission_error <= 1e-3
    assert made.phase_coefficients.size + made.transmission_coefficients.size <= 24


def test_a_ripple_between_few_entries_is_left_and_said():
    """|T| that swings by 3 % from entry to entry, 61 of them: no proxy of many
    coefficients, which would swing on.
    """
    rippled = synthetic(
        factor=lambda d: 1 - 0.03 * (1 + np.cos(2 * np.pi * d / 0.0075)), samples=61
    )
    made = proxy_fit.fit(rippled)
    assert made.turns < 1 <= made.smooth_turns
    # the ripple itself; 12 coefficients swing by 0.41
    assert 0.02 < made.proxy.max_transmission_error < 0.035
    assert (
        f"|T| within {made.proxy.max_transmission_error:.3g}, where 0.001 and 0.001 are wanted"
        in made.shortfall
    )
    assert proxy_fit.fit(synthetic()).shortfall == ""


def test_a_proxy_that_falls_short_has_no_more_coefficients_than_were_wanted():
    """Less than a turn, which no more of them would complete."""
    wanted = ProxyTolerances(
        coefficients=6, phase_tolerance_rad=1e-7, within_um=(0.06, 0.1)
    )
    made = proxy_fit.fit(synthetic(), wanted)
    assert made.smooth_turns < 1
    assert "1e-07" in made.shortfall
    assert (
        made.proxy.phase_coefficients.size
        == made.proxy.transmission_coefficients.size
        == 3
    )


def test_wavelengths_and_angles_between_those_of_the_library():
    waves, angles = (0.83, 0.84, 0.85, 0.86, 0.87), (0.0, 10.0, 20.0)
    made = proxy.fit(synthetic(waves, angles, samples=81))
    assert made.phase_coefficients.ndim == 3
    phase, level = errors(made, (0.8312, 0.853, 0.8666), np.radians([0.0, 7.3, 19.0]))
    assert phase < 2e-3
    assert level < 2e-3


def test_transmission_stays_below_one_where_the_light_all_passes():
    made = proxy.fit(
        synthetic(factor=lambda d: 1 / (0.93 + 0.07 * np.cos(40 * d + 0.85)))
    )
    for dtype in (np.float32, np.float64):
        d = np.linspace(*made.domain_um, 100_001).astype(dtype)
        assert made.transmission(d, 0.85).max() <= 1
    assert made.max_transmission_error < 1e-3


def blaschke(centre, width):
    """The factor that a lossless resonance at ``centre`` puts on t: a zero and a pole
    across the real axis.
    """
    return lambda d: (d - centre - 0.5j * width) / (d - centre + 1j * width)


def test_a_resonance_cuts_the_domain_and_says_so():
    resonant = synthetic(
        resonances=[(0, 0.0, 0.85, 0.2, 0.001)], factor=blaschke(0.2, 0.001)
    )
    made = proxy_fit.fit(resonant)
    assert made.proxy.domain_um[1] < 0.2
    assert any(
        "resonance at 0.2000 um, half-width 1 nm (0.85 um)" in note
        for note in made.notes
    )
    assert made.turns < 1.15


def test_few_entries_beside_a_resonance_are_left_to_it_for_the_tolerances():
    """Bars of 0.02 ask for 0.01 rad; the last entries, steep by a resonance of 0.4 nm,
    keep the curve 0.023 away.

    The known function at places that no entry has is met within the stated error and
    what bends between entries.
    """
    width, centre = 4e-4, 0.2
    beside = [centre - away * width for away in (2.2, 3, 5)]
    about = {
        "resonances": [(0, 0.0, 0.85, centre, width)],
        "factor": blaschke(centre, width),
        "beside": beside,
    }
    found = proxy_fit.fit(synthetic(**about, samples=41, bar=0.02))
    assert not found.shortfall
    assert any(
        "do not describe it within the tolerances" in note for note in found.notes
    )
    # a tenth of what 24 coefficients were tried on
    assert found.turns > 0.9 * found.smooth_turns - 0.1
    d = np.linspace(*found.proxy.domain_um, 301)
    exact = np.unwrap(np.angle(blaschke(centre, width)(d))) + phase_of(d, 0.85, 0.0)
    off = np.asarray(found.proxy.phase_rad(d, 0.85)) - exact
    off -= 2 * np.pi * np.round(off.mean() / (2 * np.pi))
    # 0.005 at the entries, twice the tolerance between them
    assert np.abs(off).max() < 0.02


def test_the_longer_side_of_a_resonance_is_kept():
    early = synthetic(
        resonances=[(0, 0.0, 0.85, 0.08, 0.0005)], factor=blaschke(0.08, 0.0005)
    )
    assert proxy.fit(early).domain_um[0] > 0.08


def test_dark_entries_cut_the_domain():
    made = proxy_fit.fit(synthetic(factor=lambda d: np.where(d > 0.19, 0.5, 1.0)))
    assert made.proxy.domain_um[1] <= 0.19
    assert any("|t| falls to" in note for note in made.notes)


def test_falling_phase_cuts_the_domain():
    made = proxy_fit.fit(
        synthetic(factor=lambda d: np.exp(-100j * np.maximum(d - 0.18, 0) / 0.5))
    )
    assert made.proxy.monotone(0.85)


def test_openings_in_a_film_are_the_mirror_image_of_pillars():
    """The wider an opening, the less film: conjugate t, so that the phase changes its
    sign and nothing else does.
    """
    pillars = synthetic(factor=lambda d: np.where(d < 0.08, 0.5, 1.0))
    cell = dataclasses.replace(CELL, shape=Circle(hole=True))
    openings = dataclasses.replace(pillars, cell=cell, t=pillars.t.conj())
    made, other = proxy_fit.fit(openings), proxy_fit.fit(pillars)
    assert made.proxy.domain_um == other.proxy.domain_um
    assert other.turns > 1
    assert made.turns == pytest.approx(other.turns)
    d = np.linspace(0.1, 0.2, 7)
    turn = made.proxy.phase_rad(d, 0.85) + phase_of(d, 0.85, 0.0)
    # tolerances of the fit
    assert np.exp(1j * turn) == pytest.approx(np.ones(7), abs=2e-3)
    wanted = np.array([-3.0, -0.4, 1.7])
    found = made.proxy.phase_rad(made.proxy.diameter_um(wanted, 0.85), 0.85)
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * wanted))
    with pytest.raises(DomainError, match="rises with the size of the opening"):
        proxy_fit.fit(dataclasses.replace(pillars, cell=cell))


def test_an_entry_whose_bar_is_above_half_of_its_light_cuts_the_domain():
    made = synthetic()
    bars = made.t_error.copy()
    bars[..., 130] = 0.51 * np.abs(made.t[..., 130])
    bars[..., 20] = 0.49 * np.abs(made.t[..., 20])
    found = proxy_fit.longest_monotonic_branch(
        dataclasses.replace(made, t_error=bars), ProxyTolerances()
    )
    assert (found.diameter_um[0], found.diameter_um[-1]) == (
        made.diameter_um[0],
        made.diameter_um[129],
    )
    assert any(
        f"an error bar above half of |t| ({bars[..., 130].max():.2g})" in note
        for note in found.notes
    )


@pytest.mark.parametrize(("scale", "doubted"), [(0.97, False), (1.03, True)])
def test_pillars_whose_bars_are_a_tenth_of_their_light_are_doubted(scale, doubted):
    """Bars of 0.02 and of sqrt(2 x 0.1² - 0.02²) in turn are a tenth of |t|, root mean
    square.
    """
    made = synthetic(samples=160)
    bars = (
        scale
        * np.abs(made.t)
        * np.where(np.arange(160) % 2, 0.02, math.sqrt(2 * 0.01 - 4e-4))
    )
    found = proxy_fit.fit(dataclasses.replace(made, t_error=bars)).proxy
    assert bool(found.doubt) is doubted
    assert (
        not doubted
        or "bars are 0.1 of |t| (root mean square), 0.1 at the most" in found.doubt
    )


def test_resonances_everywhere_are_refused():
    dense = [(0, 0.0, 0.85, c, 0.004) for c in np.arange(0.06, 0.22, 0.01)]
    with pytest.raises(
        DomainError, match=r"no 12 diameters in a row .* choose another pitch"
    ):
        proxy_fit.fit(synthetic(resonances=dense))


def test_within_narrows_the_domain():
    made = proxy.fit(synthetic(), ProxyTolerances(within_um=(0.1, 0.2)))
    assert made.domain_um[0] >= 0.1 - 1e-9
    assert made.domain_um[1] <= 0.2 + 1e-9


def test_few_coefficients_shorten_the_domain_but_not_below_a_turn():
    made = proxy_fit.fit(
        synthetic(),
        ProxyTolerances(
            coefficients=8, phase_tolerance_rad=1e-4, transmission_tolerance=1e-4
        ),
    )
    assert made.turns >= 1
    assert made.proxy.phase_coefficients.size > 4


def test_polarisations_are_averaged_and_their_spread_is_told():
    both = synthetic(angles=(0.0, 10.0))
    shifted = both.t.copy()
    shifted[1] *= np.exp(0.02j)
    made = proxy_fit.fit(
        PillarLibrary(
            **{n: getattr(both, n) for n in PillarLibrary.__slots__} | {"t": shifted}
        )
    )
    assert made.polarization_spread == pytest.approx(0.01, rel=0.1)


def test_phase_is_continuous_over_wavelength_and_angle():
    waves, angles = (0.83, 0.85, 0.87), (0.0, 20.0)
    stretch = proxy_fit.longest_monotonic_branch(
        synthetic(waves, angles), ProxyTolerances()
    )
    d = stretch.diameter_um
    w = np.array(waves)[None, :, None]
    a = np.radians(angles)[:, None, None]
    off = stretch.phase - phase_of(d, w, a)
    assert abs(off - off[0, 0, 0]).max() < 1e-9


def test_default_cell_meets_its_numbers():
    made = library.sweep(library.DEFAULT_CELL, Sweep(tolerance=5e-3))
    fitted = proxy_fit.fit(made)
    p = fitted.proxy
    assert p.phase_coefficients.size + p.transmission_coefficients.size <= 24
    assert p.max_phase_error_rad <= 1e-3
    assert p.max_transmission_error <= 1e-3
    assert p.monotone(0.85)
    # printable pillars cover a full turn
    assert p.coverage_rad(0.85, within_um=(0.08, p.domain_um[1])) >= TURN


def test_a_candidate_that_turns_negative_between_entries_is_passed_over():
    """A dip of |T| among entries so few that high degrees swing below 0 between them:
    those fits are no proxies.
    """
    made = synthetic(
        factor=lambda d: 1 - 0.85 * np.exp(-(((d - 0.2) / 0.002) ** 2)), samples=60
    )
    fitted = proxy_fit.fit(made, ProxyTolerances(least_transmission=0.05))
    assert 0.19 < fitted.proxy.domain_um[1] < 0.2  # up to the dip
    assert fitted.shortfall == ""


def test_a_dip_that_no_candidate_follows_is_refused():
    made = synthetic(
        factor=lambda d: 1 - 0.995 * np.exp(-(((d - 0.1) / 0.003) ** 2)), samples=60
    )
    with pytest.raises(DomainError, match="sweep with more samples") as refused:
        proxy_fit.fit(made, ProxyTolerances(least_transmission=0.001))
    # what the proxy says of its coefficients is no advice to a user
    assert "fit it again" not in str(refused.value)


def test_errors_of_phase_and_transmission_stand_each_in_its_place():
    made = proxy.fit(
        synthetic(),
        ProxyTolerances(
            coefficients=8, phase_tolerance_rad=0.3, transmission_tolerance=0.1
        ),
    )
    phase, level = errors(made, (0.85,), (0.0,))
    # between the samples
    assert made.max_phase_error_rad == pytest.approx(phase, rel=0.1)
    assert made.max_transmission_error == pytest.approx(level, rel=0.1)
    assert abs(phase / level - 1) > 0.3


def test_pillars_on_both_sides_of_a_very_narrow_resonance_are_used():
    """Of 0.003 nm: at 5 nm its tail turns the phase by 1.5 x 0.003 / 5 = 9e-4 rad."""
    centre, width = 0.1731, 3e-6
    library = synthetic(
        resonances=[(0, 0.0, 0.85, centre, width)], factor=blaschke(centre, width)
    )
    found = proxy_fit.fit(library)
    assert found.proxy.domain_um[1] > 0.21
    assert (
        found.turns
        > 1.2 * proxy_fit.fit(library, ProxyTolerances(within_um=(0.06, 0.172))).turns
    )
    (gap,) = found.proxy.gaps_um
    assert gap == pytest.approx((centre - 0.005, centre + 0.005))
    phase = np.linspace(-3, 3, 4001)
    made = found.proxy.diameter_um(phase, 0.85, gap="nearest")
    assert (abs(made - centre) > 0.005 - 1e-12).all()
    reached = np.angle(np.exp(1j * (phase_of(made, 0.85, 0.0) - phase)))
    steepest = np.diff(phase_of(np.array([0.168, 0.178]), 0.85, 0.0))[0]
    # half of the gap, or the tolerance and the resonance's tail
    assert np.abs(reached).max() < steepest / 2 + 3e-3
    assert np.median(np.abs(reached)) < 3e-3
