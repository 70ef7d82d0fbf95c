"""A proxy by hand: Chebyshev polynomials at chosen places of diameter, wavelength and
angle; its error and ends.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from metalens.ground.errors import DomainError
from metalens.pillars.proxy import Proxy

LOW, HIGH = 0.1, 0.3
PHASE, LEVEL = (
    np.array([[1.0, 2.0, 0.25], [0.3, -0.2, 0.05]]),
    np.array([[0.8, 0.1], [-0.05, 0.02]]),
)
# x = 0.5 of the diameter is 0.25 um; y = -0.4 of the wavelength is 0.82 um
D, WAVE = 0.25, 0.82


def proxy(**other):
    return dataclasses.replace(
        Proxy(PHASE, LEVEL, (LOW, HIGH), (0.79, 0.89), 0.03, 0.02), **other
    )


def test_value_and_slope_are_those_of_the_polynomials():
    """T0, T1, T2 at 0.5: 1, 0.5, -0.5, slopes 0, 1, 2; of the wavelength 1 and -0.4;
    ten units of x a micrometre.
    """
    assert proxy().phase_rad(D, WAVE) == pytest.approx(
        1 + 1 - 0.125 - 0.4 * (0.3 - 0.1 - 0.025), rel=1e-12
    )
    assert proxy().transmission(D, WAVE) == pytest.approx(
        0.85 - 0.4 * (-0.04), rel=1e-12
    )
    assert proxy().dphase_ddiameter(D, WAVE) == pytest.approx(
        10 * (2.5 - 0.4 * (-0.2 + 0.1)), rel=1e-12
    )
    assert proxy().dtransmission_ddiameter(D, WAVE) == pytest.approx(
        10 * (0.1 - 0.4 * 0.02), rel=1e-12
    )
    both = proxy().phase_rad(np.array([[D, 0.2]], np.float32), WAVE)
    assert (both.dtype, both.shape) == (np.float32, (1, 2))
    assert both[0, 1] == pytest.approx(0.75 - 0.4 * (0.3 - 0.05), rel=1e-6)  # float32
    seen = proxy().phase_rad(torch.tensor([D, 0.2], dtype=torch.float64), WAVE)
    assert isinstance(seen, torch.Tensor)
    assert seen.tolist() == pytest.approx([1.875 - 0.07, 0.65], rel=1e-12)


def test_a_power_of_the_diameter_is_what_the_polynomials_run_in():
    """Squares from 0.01 to 0.09: their middle 0.05 stands for 0, 0.07 for 0.5."""
    squared = proxy(power=2)
    assert squared.phase_rad(math.sqrt(0.07), WAVE) == pytest.approx(
        1.875 - 0.07, rel=1e-12
    )


def test_angles_run_in_the_square_of_their_sine():
    """sin² a quarter of the largest: 2/4 - 1 = -0.5; normal incidence -1, the largest
    1.
    """
    most = 0.6
    tables = [np.stack([table, 0.1 * table]) for table in (PHASE, 0.8 * LEVEL)]
    angled = proxy(
        phase_coefficients=tables[0],
        transmission_coefficients=tables[1],
        max_angle_rad=most,
    )
    quarter = math.asin(math.sin(most) / 2)
    for angle, share in (
        (quarter, 0.95),
        (-quarter, 0.95),
        (0.0, 0.9),
        (most, 1.1),
        (most + 0.9e-9, 1.1),
    ):
        assert angled.phase_rad(D, WAVE, angle) == pytest.approx(
            share * 1.805, rel=1e-9
        )
        assert angled.transmission(D, WAVE, angle) == pytest.approx(
            share * 0.8 * 0.866, rel=1e-9
        )
    assert angled.phase_rad(D, WAVE, most + 0.9e-9) == angled.phase_rad(D, WAVE, most)
    for angle in (most + 1.2e-9, -most - 1.2e-9):
        with pytest.raises(DomainError, match=r"holds up to 0\.6 rad"):
            angled.phase_rad(D, WAVE, angle)
    with pytest.raises(DomainError, match="normal incidence only"):
        proxy().phase_rad(D, WAVE, 0.1)
    assert proxy().max_angle_rad == 0.0


def test_wavelengths_end_a_billionth_beyond_the_range_and_one_has_no_slope():
    for wave, want in ((0.79 - 0.9e-9, -1.0), (0.89 + 0.9e-9, 1.0)):
        assert proxy().phase_rad(D, wave) == pytest.approx(
            1.875 + want * 0.175, rel=1e-6
        )
    for wave in (0.79 - 1.2e-9, 0.89 + 1.2e-9):
        with pytest.raises(DomainError, match=r"holds from 0\.79 to 0\.89 um"):
            proxy().phase_rad(D, wave)
    assert proxy(wavelengths_um=(0.82, 0.82)).phase_rad(D, WAVE) == pytest.approx(
        1.875, rel=1e-12
    )


def test_the_error_adds_squares_of_phase_level_over_the_mean_and_entries():
    """|T| = 0.82 + 0.092 x at this wavelength: its mean over the diameters is 0.82."""
    want = math.sqrt(0.03**2 + (0.02 / 0.82) ** 2 + 0.011**2)
    assert proxy(entry_error=0.011).error(WAVE) == pytest.approx(want, rel=1e-9)
    assert proxy().entry_error == 0.0


def test_the_mean_level_is_that_of_65_places_with_both_ends():
    """Squares of n places evenly from -1 to 1 have the mean (n + 1) / (3 (n - 1)) =
    66/192; T2 is twice that less 1.
    """
    bent = proxy(
        transmission_coefficients=np.array([[0.5, 0.0, 0.3]]),
        phase_coefficients=PHASE[:1],
    )
    mean = 0.5 + 0.3 * (2 * 66 / 192 - 1)
    assert bent.error(WAVE) == pytest.approx(math.hypot(0.03, 0.02 / mean), rel=1e-9)


def test_entries_that_are_too_doubtful_are_named():
    """A tenth of |t| at the most."""
    assert proxy(entry_error=0.1).doubt == ""
    assert (
        "0.11 of |t| (root mean square), 0.1 at the most"
        in proxy(entry_error=0.11).doubt
    )


def test_coverage_and_monotony_are_of_the_range_that_is_asked():
    """Between x = -1 and 1 the phase takes twice its first coefficient; a bend of 0.6
    turns it at x = -1 / 1.2.
    """
    assert proxy().coverage_rad(WAVE) == pytest.approx(2 * 2.08, rel=1e-12)
    falling = proxy(
        phase_coefficients=np.array([[1.0, -2.0, 0.25]]),
        transmission_coefficients=LEVEL[:1],
    )
    assert falling.coverage_rad(WAVE, within_um=(0.2, 0.25)) == pytest.approx(
        0.875, rel=1e-12
    )  # 0.75 to -0.125
    assert proxy().monotone(WAVE)
    turning = proxy(
        phase_coefficients=np.array([[1.0, 2.0, 0.6]]),
        transmission_coefficients=LEVEL[:1],
    )
    assert not turning.monotone(WAVE)
    assert turning.monotone(WAVE, within_um=(0.12, 0.3))


def test_a_phase_is_found_again_modulo_whole_turns():
    assert proxy().diameter_um(1.805 - 2 * math.pi, WAVE) == pytest.approx(D, abs=1e-9)


def test_levels_above_one_by_the_width_of_the_certificate_are_cut():
    """0.8 + 0.2001 x reaches 1.0001; 3e-3 of the range of 0.4 are allowed, 0.0012, and
    1e-12 of none.
    """
    row = {
        "phase_coefficients": PHASE[:1],
        "transmission_coefficients": np.array([[0.8, 0.2001]]),
    }
    assert proxy(**row).transmission(HIGH, WAVE) == 1.0
    for table in (
        [[0.8, 0.2014]],
        [[0.2, -0.2014]],
        [[1 + 3e-12, 0.0]],
        [[-3e-12, 0.0]],
    ):
        with pytest.raises(DomainError, match="need 0 to 1"):
            proxy(**row | {"transmission_coefficients": np.array(table)})
    for table in ([[0.8, 0.201]], [[0.2, -0.201]], [[1 + 5e-13, 0.0]], [[-5e-13, 0.0]]):
        proxy(**row | {"transmission_coefficients": np.array(table)})


@pytest.mark.parametrize("domain", [(-0.1, 0.3), (0.3, 0.3), (0.1, math.inf)])
def test_an_empty_domain_is_refused(domain):
    with pytest.raises(DomainError, match="need 0 <= least < largest"):
        proxy(domain_um=domain)


def test_arrays_bring_everything_back():
    first = proxy(power=2, max_angle_rad=0.4, entry_error=0.017)
    arrays = first.to_arrays()
    back = Proxy.from_arrays(arrays)
    for name in (
        "domain_um",
        "wavelengths_um",
        "max_phase_error_rad",
        "max_transmission_error",
        "power",
    ):
        assert getattr(back, name) == getattr(first, name)
    assert (back.max_angle_rad, back.entry_error) == (0.4, 0.017)
    assert np.array_equal(back.phase_coefficients, PHASE)
    assert np.array_equal(back.transmission_coefficients, LEVEL)
