"""Lenses: profiles against closed forms, pillars that make the wanted phase, refusals
by name.
"""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from metalens import lens
from metalens.cell.record import Cell, Index
from metalens.core.errors import ConfigError, LensError
from metalens.design import assign as design
from metalens.design import phase_map, profiles
from metalens.design.assign import Limits
from metalens.design.profiles import Cubic, DoubleHelix, Focus, PhaseMap
from metalens.library.proxy import Proxy
from metalens.optics.paths import axial_path_difference

CELL = Cell(pitch_um=0.35, pillar=Index(3.6), substrate=Index(1.45))
FOCUS = Focus(0.85, 2000.0, 20_000.0)


@pytest.fixture(scope="module")
def proxy():
    """Phase 7.5 u + u² and |T| 0.9 + 0.05 u on u in [-1, 1]: 2.4 turns over 80-290 nm."""
    return Proxy(
        phase_coefficients=np.array([[0.5, 7.5, 0.5]]),
        transmission_coefficients=np.array([[0.9, 0.05]]),
        domain_um=(0.08, 0.29),
        wavelengths_um=(0.85, 0.85),
        max_phase_error_rad=0.0,
        max_transmission_error=0.0,
    )


def _make(proxy, phase=None, *, aperture_um=60.0, cell=CELL, **options):
    phase = phase or design.phase_of(None, FOCUS, radius_um=aperture_um / 2)
    return design.make(
        phase, FOCUS, aperture_um=aperture_um, cell=cell, proxy=proxy, **options
    )


def test_hyperbolic_phase_makes_all_paths_equal():
    x = np.linspace(-500, 500, 41)
    path = np.hypot(x, 2000.0) + np.hypot(x, 20_000.0)
    phase = profiles.hyperbolic_phase(x, np.zeros(1), FOCUS)
    total = phase + 2 * np.pi / 0.85 * (path - 22_000.0)
    # double precision of a path of 2.2e4 um times k = 7.4: 3e-11 relative
    assert np.abs(total).max() < 1e-8


@given(st.floats(1.0, 1e3), st.floats(10.0, 1e5))
def test_path_difference_keeps_its_digits(radius, distance):
    import mpmath

    with mpmath.workdps(40):
        want = float(
            mpmath.sqrt(mpmath.mpf(radius) ** 2 + mpmath.mpf(distance) ** 2)
            - mpmath.mpf(distance)
        )
    assert float(
        axial_path_difference(np.float64(radius**2), distance)
    ) == pytest.approx(want, rel=1e-14)


def _phase_at(shape, focus, radius, x, y):
    phase = design.phase_of(shape, focus, radius_um=radius)
    pairs = zip(np.array(x), np.array(y), strict=True)
    return np.array([float(phase(a[None], b[None])[0, 0]) for a, b in pairs])


def test_double_helix_winds_one_three_five_times():
    shape = DoubleHelix(zones=3)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False) + 0.003
    for ring in (1, 2, 3):
        radius = 30.0 * math.sqrt((ring - 0.5) / 3)
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        phase = _phase_at(shape, FOCUS, 30.0, x, y)
        turns = np.diff(np.unwrap(np.r_[phase, phase[0]])).sum() / (2 * np.pi)
        assert round(turns) == 2 * ring - 1


def test_every_pillar_makes_the_wanted_phase(proxy):
    made, quality = _make(proxy)
    d = made.diameters
    wanted = profiles.hyperbolic_phase(d.x_um, d.y_um[:, None], FOCUS)
    error = np.angle(np.exp(1j * (made.phase_rad() - wanted)))[d.diameter_um > 0]
    # float32 diameters: 2e-8 um x 90 rad/um, and the proxy's inverse
    assert np.abs(error).max() < 2e-5
    assert quality.max_phase_error_rad < 2e-5
    assert quality.strehl == pytest.approx(
        made.transmission()[d.diameter_um > 0].mean() ** 2
        / made.transmission()[d.diameter_um > 0].mean() ** 2
    )
    assert quality.wavefront_efficiency == pytest.approx(
        made.transmission()[d.diameter_um > 0].mean() ** 2, rel=1e-6
    )


def test_asymmetric_map_lands_the_right_way_up(proxy, tmp_path):
    phase = np.zeros((60, 80))
    phase[:30] = 1.0  # upper half: small row index, negative y
    phase[:, :40] += 0.5  # left half
    np.save(tmp_path / "p.npy", phase)
    wanted = design.phase_of(PhaseMap(tmp_path / "p.npy", 1.0), FOCUS, radius_um=20.0)
    made, _ = _make(proxy, wanted, aperture_um=40.0)
    got = np.mod(made.phase_rad(), 2 * np.pi)
    n = len(got)
    quarter, rest = n // 4, 3 * n // 4
    assert got[quarter, quarter] == pytest.approx(1.5, abs=1e-4)
    assert got[quarter, rest] == pytest.approx(1.0, abs=1e-4)
    assert got[rest, quarter] == pytest.approx(0.5, abs=1e-4)


def test_map_with_focus_from_csv(proxy, tmp_path):
    np.savetxt(tmp_path / "p.csv", np.full((50, 50), 0.7), delimiter=",")
    shape = PhaseMap(tmp_path / "p.csv", 1.0, add_focus=True)
    x = np.linspace(-20, 20, 5)
    got = design.phase_of(shape, FOCUS, radius_um=20.0)(x, x)
    assert got == pytest.approx(0.7 + profiles.hyperbolic_phase(x, x[:, None], FOCUS))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full((4, 4), np.nan), "row 0, column 0 is nan"),
        (np.zeros(5), r"shape \(5,\)"),
        (np.outer([1, 1, 1, 1j], [1, 2, 1, 1]), "phase alone"),
        (np.tile([0.0, np.pi], (40, 20)), "finer pitch"),
        (np.zeros((4, 4)), "less than the aperture"),
    ],
)
def test_bad_maps_are_refused(tmp_path, array, message):
    np.save(tmp_path / "p.npy", array)
    shape = PhaseMap(tmp_path / "p.npy", 1.0)
    x = np.linspace(-15, 15, 31)
    with pytest.raises(LensError, match=message):
        design.phase_of(shape, FOCUS, radius_um=15.0)(x, x)


def test_missing_map_and_bad_settings_are_refused(tmp_path):
    with pytest.raises(LensError, match="no such file"):
        phase_map.read_phase_map(PhaseMap(tmp_path / "absent.npy", 1.0))
    with pytest.raises(ConfigError, match="zones"):
        DoubleHelix(zones=0)
    with pytest.raises(LensError, match="source_distance_um"):
        Focus(0.85, 2000.0, -1.0)
    with pytest.raises(ConfigError, match="min_gap_nm"):
        Limits(min_gap_nm=0)


def test_empty_aperture_and_unprintable_cells_are_refused(proxy):
    with pytest.raises(LensError, match="empty aperture"):
        _make(proxy, aperture_um=0.1)
    with pytest.raises(LensError, match="no printable pillar"):
        _make(proxy, limits=Limits(min_diameter_nm=295))
    with pytest.raises(LensError, match=r"of a turn.* need 1; take"):
        _make(proxy, limits=Limits(min_diameter_nm=230))


def test_a_turn_that_a_resonance_cut_short_is_not_laid_to_the_process():
    short = Proxy(
        np.array([[0.5, 2.0, 0.1]]),
        np.array([[0.9]]),
        (0.08, 0.16),
        (0.85, 0.85),
        0.0,
        0.0,
    )
    ends = r"prints 0\.0900-0\.\d+ um, the library's curve holds 0\.0800-0\.1600.*lies below 0\.236"
    with pytest.raises(LensError, match=ends):
        _make(short, limits=Limits(min_diameter_nm=90, min_gap_nm=80))


def test_the_height_that_is_named_covers_a_turn_of_an_index_that_is_the_pillars_own():
    """Phase k h n(D), n from 1.41 at 0.09 um to 2.03 at 0.32 um: 0.62 h / wavelength
    turns, so 1.371 um at 0.85 um.
    """

    def guides(height_um):
        phase = 2 * np.pi / 0.85 * height_um * np.array([[1.72, 0.31]])
        return Proxy(phase, np.array([[0.9]]), (0.09, 0.32), (0.85, 0.85), 0.0, 0.0)

    printed = Limits(min_diameter_nm=90, min_gap_nm=80)
    cell = Cell(pitch_um=0.4, height_um=0.52, pillar=Index(3.2))
    with pytest.raises(
        LensError,
        match=r"reach 0\.379 of a turn.*; take pillars of about 1\.37 um \(0\.52 um now",
    ):
        _make(guides(0.52), limits=printed, cell=cell)
    _make(guides(1.38), limits=printed, cell=dataclasses.replace(cell, height_um=1.38))


def test_a_phase_of_another_shape_is_refused_with_what_is_needed(proxy):
    focus = Focus(0.85, 300.0, math.inf)
    make = partial(
        design.make,
        focus=focus,
        aperture_um=8.0,
        cell=Cell(pitch_um=0.4, pillar=Index(3.6)),
        proxy=proxy,
    )
    with pytest.raises(LensError, match=r"phase of shape \(20,\) .*need \(20, 20\)"):
        # positions along the diagonal alone
        make(lambda x, y: profiles.hyperbolic_phase(x, y, focus))
    with pytest.raises(LensError, match=r"phase of shape \(\) "):
        make(lambda x, y: 0.0)


def test_one_pillar_is_a_lens(proxy):
    made, quality = _make(proxy, aperture_um=0.5)
    assert made.diameters.diameter_um.shape == (1, 1)
    assert quality.pillars == 1


def test_field_is_limited_by_coma_as_in_third_order_theory():
    assert design.field_angle(FOCUS, 100.0) > design.field_angle(FOCUS, 500.0)
    # Coma of a flat hyperbolic lens at its own focus: W131 = R³ theta / (2 d²) (Aieta
    # et al. 2013), RMS about the
    # best tilt W131 / sqrt(72). At R/d = 1/4 the next order is (R/d)² = 6 %,
    # astigmatism adds 3 % in quadrature.
    focus, radius = Focus(0.85, 2000.0), 500.0
    rms = math.sqrt(-math.log(0.8)) * 0.85 / (2 * math.pi)
    want = rms * math.sqrt(72) * 2 * focus.sensor_distance_um**2 / radius**3
    assert design.field_angle(focus, radius) == pytest.approx(want, rel=0.1)


@pytest.mark.parametrize(
    ("bad", "place"),
    [(np.nan, "row 2, column 3"), (-0.1, "row 2"), (0.35, "0.35"), (np.inf, "inf")],
)
def test_bad_diameters_name_row_and_column(bad, place):
    d = np.full((5, 6), 0.2)
    d[2, 3] = bad
    with pytest.raises(LensError, match=place):
        lens.DiameterMap(d, 0.35)


def test_empty_and_misshapen_maps_are_refused():
    with pytest.raises(LensError, match="holds no pillar"):
        lens.DiameterMap(np.zeros((3, 3)), 0.35)
    with pytest.raises(LensError, match=r"need \(y, x\)"):
        lens.DiameterMap(np.zeros(3), 0.35)


def test_the_axis_sits_in_the_middle():
    odd = lens.DiameterMap(np.full((3, 4), 0.2), 0.5)
    assert odd.y_um.tolist() == [-0.5, 0.0, 0.5]
    assert odd.x_um.tolist() == [-0.75, -0.25, 0.25, 0.75]
    assert odd.radius_um == pytest.approx(math.hypot(0.5, 0.75))


def test_profiles_at_a_site_off_both_axes():
    """Every term by hand at (7, -4) um: sources and sensor at unlike distances, signs
    of x and y unlike.
    """
    focus, x, y, radius = Focus(0.94, 210.0, 930.0), 7.0, -4.0, 11.0
    # 0.15 um of 210: 13 digits are left
    paths = sum(math.hypot(x, y, z) - z for z in (210.0, 930.0))
    focal = -2 * math.pi / 0.94 * paths
    assert float(
        profiles.hyperbolic_phase(np.array(x), np.array(y), focus)
    ) == pytest.approx(focal, abs=1e-10)
    cubed = _phase_at(Cubic(37.0), focus, radius, [x], [y])[0]
    assert cubed - focal == pytest.approx(37 * (343 - 64) / 1331, abs=1e-9)
    # ring: ceil(3 (sqrt 65 / 11)^(1 / 0.7)) = ceil(1.92) = 2, of charge 3
    helix = _phase_at(DoubleHelix(3, 0.7), focus, radius, [x], [y])[0]
    assert helix - focal == pytest.approx(3 * math.atan2(-4, 7), abs=1e-9)


def test_less_than_a_turn_is_accepted_with_its_loss_stated(proxy):
    """Uniform phases: the missing m rad are met at their ends, m / 2 off at most, m³ /
    (24 pi) mean square.
    """
    lens, quality = _make(
        proxy,
        aperture_um=300.0,
        limits=Limits(min_diameter_nm=210),
        accept_partial_turn=True,
    )
    missing = 2 * np.pi * (1 - quality.turns)
    assert 0.4 < missing < 0.7
    assert quality.max_phase_error_rad == pytest.approx(missing / 2, rel=0.02)
    assert quality.rms_phase_error_rad == pytest.approx(
        np.sqrt(missing**3 / (24 * np.pi)), rel=0.1
    )
    assert lens.diameters.diameter_um[
        lens.diameters.diameter_um > 0
    ].min() >= np.float32(0.21)
    whole = _make(proxy)[1]
    assert whole.turns > 1
    assert whole.rms_phase_error_rad < 1e-5


@pytest.mark.parametrize("source", [math.inf, 5100.0])
def test_half_field_is_where_the_wave_front_leaves_four_fifths(source):
    """Rays by hand: chief point at d tan(angle) behind and -z tan(angle) before; piston
    and tilt fitted out, the focus
    not, since the sensor is flat."""
    focus, radius = Focus(0.94, 1300.0, source), 170.0
    angle = design.field_angle(focus, radius)
    rho, turn = (
        np.sqrt((np.arange(60) + 0.5) / 60),
        (np.arange(90) + 0.5) * 2 * np.pi / 90,
    )  # equal areas
    x, y = (radius * rho[:, None] * f(turn) for f in (np.cos, np.sin))

    def variance(tilt):
        place = 1300.0 * math.tan(tilt)
        path = np.sqrt((x - place) ** 2 + y**2 + 1300.0**2)
        if math.isinf(source):
            path = path + x * math.sin(tilt) - np.sqrt(x**2 + y**2 + 1300.0**2)
        else:
            path = path + np.sqrt((x + source * math.tan(tilt)) ** 2 + y**2 + source**2)
            path = path - sum(np.sqrt(x**2 + y**2 + z**2) for z in (1300.0, source))
        terms = np.stack([np.ones_like(x), x, y], -1).reshape(-1, 3)
        rest = (
            path.ravel() - terms @ np.linalg.lstsq(terms, path.ravel(), rcond=None)[0]
        )
        return float((rest**2).mean()) * (2 * math.pi / 0.94) ** 2

    # 61 x 61 square samples of the disc against equal areas: 2 % of the variance
    assert math.exp(-variance(angle)) == pytest.approx(0.8, abs=0.008)
    assert design.field_angle(focus, radius, strehl=0.4) > 1.2 * angle
