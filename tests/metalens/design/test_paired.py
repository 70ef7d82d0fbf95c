"""Lenses of pillars of two sizes: phases known in closed form, two foci, limits of the
process, files, masks' input.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import design, lens, psf
from metalens.cell import Cell, Index
from metalens.cell.shapes import Rectangle
from metalens.core.errors import ConfigError, DomainError, LensError, PropagationError
from metalens.design import Focus, Limits
from metalens.library import Sweep
from metalens.library.axes import AxesLibrary

X = np.linspace(0.1, 0.3, 81)
Y = np.linspace(0.12, 0.28, 65)
WAVELENGTH = 0.94
CELL = Cell(0.4, 0.5, Index(3.6), shape=Rectangle())
NEAR = Focus(WAVELENGTH, 37.0, math.inf)
FAR = Focus(WAVELENGTH, 52.0, math.inf)
LEVELS = 0.95, 0.88
LEAK = 0.11


def library(turns=(1.1, 1.07), error=0.01):
    """Each size turns one polarisation by itself, a little more than a turn; a band of
    long bars.
    """
    x, y = np.meshgrid(X, Y, indexing="ij")
    t = np.zeros((1, len(X), len(Y), 2, 2), complex)
    t[0, ..., 0, 0] = LEVELS[0] * np.exp(2j * np.pi * turns[0] * (x - 0.1) / 0.2 + 0.4j)
    t[0, ..., 1, 1] = LEVELS[1] * np.exp(
        2j * np.pi * turns[1] * (y - 0.12) / 0.16 - 1.3j
    )
    t[0, ..., 1, 0], t[0, ..., 0, 1] = LEAK, LEAK / 2
    bars = np.full((1, len(X), len(Y)), error)
    bars[0, 30:33] = 0.5
    sweep = Sweep(
        (WAVELENGTH,), diameters_um=(0.1, 0.3), lengths_um=(0.12, 0.28), tolerance=0.05
    )
    return AxesLibrary(
        CELL, sweep, np.array([WAVELENGTH]), X, Y, t, bars, np.zeros((1, 5)), 1, 9
    )


def made(*, both=True, **about):
    phases = [design.phase_of(None, focus, radius_um=10.0) for focus in (NEAR, FAR)]
    arguments = {
        "aperture_um": 20.0,
        "library": library(),
        "limits": Limits(100, 90),
    } | about
    second, focus = (phases[1], FAR) if both else (None, NEAR)
    return design.assign_polarization_multiplexed(
        (phases[0], second), (NEAR, focus), **arguments
    )


@pytest.fixture(scope="module")
def two():
    return made()


def test_each_polarisation_has_its_own_focus_with_the_light_of_its_pillars(two):
    """Steps of the sizes: 1.1 turns / 80 and 1.07 / 64; a band of 3 of 81 steps is left
    out: rms 0.04 rad at most.
    """
    made_lens, split = two
    for light, quality, focus, level in (
        ("x", split.x, NEAR, LEVELS[0]),
        ("y", split.y, FAR, LEVELS[1]),
    ):
        seen = made_lens.for_polarization(light)
        assert seen.sensor_distance_um == focus.sensor_distance_um
        found = design.check_focus(seen)
        assert found.passed
        assert found.figures.strehl == pytest.approx(1, abs=3e-3)
        assert quality.wavefront_efficiency == pytest.approx(level**2, rel=3e-3)
        assert quality.rms_phase_error_rad < 0.05
    wrong = dataclasses.replace(
        made_lens.for_polarization("y"), sensor_distance_um=NEAR.sensor_distance_um
    )
    # a depth of focus away
    assert design.check_focus(wrong, axial=False).figures.strehl < 0.7
    assert split.leaked == pytest.approx((LEAK**2, LEAK**2 / 4))
    assert split.wavefront_efficiency_error[0] == pytest.approx(
        2 * math.sqrt(split.x.wavefront_efficiency) * 0.01 + 1e-4
    )


def test_what_is_known_of_the_pillars_goes_with_the_lens_into_the_budget_of_its_psfs(
    tmp_path,
):
    """Bars that grow with the width: their root mean square over the pillars of the
    map, over the lesser |t|. Light of
    a focus of NA 0.26 that goes astray lies beside it or upon it: 0.1 to 2 of the bars,
    and twice for twice as long."""
    given, told = library(), []
    for times in (1, 2):
        bars = (
            np.minimum(times * (0.01 + 0.1 * (X - 0.1)), 0.05)[:, None]
            + 0 * given.t_error
        )
        bars[0, 30:33] = 0.5
        lens.save(
            tmp_path / f"{times}.h5",
            made(library=dataclasses.replace(given, t_error=bars))[0],
        )
        back = lens.load(tmp_path / f"{times}.h5")
        width = back.diameters.diameter_um[back.diameters.diameter_um > 0].astype(float)
        rms = (
            math.sqrt(
                np.mean(np.minimum(times * (0.01 + 0.1 * (width - 0.1)), 0.05) ** 2)
            )
            / LEVELS[1]
        )
        assert back.pairs.entry_error == pytest.approx(rms, rel=1e-6)
        assert back.proxy.entry_error == back.pairs.entry_error
        budget = psf.from_lens(
            back, psf.View((math.inf,), window_um=12.0, samples=12), tolerance=1e-3
        ).budget
        assert 0.1 * rms < budget.proxy <= 2 * rms
        assert budget.total > budget.proxy
        told.append(budget.proxy / rms)
    assert told[1] == pytest.approx(told[0], rel=1e-6)


def test_bands_of_long_bars_are_not_used(two):
    made_lens, _ = two
    d = made_lens.diameters
    there = d.diameter_um > 0
    used = np.rint((d.diameter_um[there] - 0.1) / 0.0025)
    assert not np.isin(used, (30, 31, 32)).any()
    assert np.isin(used, (29, 33)).any()


def test_one_phase_for_both_keeps_any_polarisation():
    made_lens, _ = made(both=False)
    phases = [
        made_lens.for_polarization(light).phase_rad()[
            made_lens.diameters.diameter_um > 0
        ]
        for light in ("x", "y")
    ]
    apart = np.angle(np.exp(1j * (phases[0] - phases[1])))
    assert np.abs(apart).max() < 0.25  # two half steps, and the band that is left out
    assert np.sqrt((apart**2).mean()) < 0.08
    assert design.check_focus(made_lens.for_polarization("y")).passed
    one, other = (
        psf.from_lens(
            made_lens.for_polarization(v),
            psf.View((math.inf,), window_um=8.0, samples=16),
        )
        for v in "xy"
    )
    mean = psf.mean_over_polarizations(one, other)
    light = [s.intensity * s.energy_um2[..., None, None] for s in (one, other, mean)]
    assert np.allclose(
        light[2], (light[0] + light[1]) / 2, rtol=1e-5, atol=1e-9 * light[2].max()
    )
    with pytest.raises(PropagationError, match="two sizes"):
        psf.from_lens(
            made_lens,
            psf.View((math.inf,), window_um=8.0, samples=16),
            polarisation="vector",
        )


def test_less_than_a_turn_is_stated():
    _, split = made(both=False, library=library((0.6, 0.6)))
    assert split.x.strehl < 0.95
    # 0.2 turns beyond either end, and the steps
    assert split.x.max_phase_error_rad > 0.8


def test_what_is_not_printed_is_not_used_and_nothing_left_is_refused():
    made_lens, _ = made(limits=Limits(min_diameter_nm=150, min_gap_nm=130))
    d = made_lens.diameters
    there = d.diameter_um > 0
    for size in (d.diameter_um[there], d.length_um[there]):
        assert 0.15 - 1e-6 <= size.min() < size.max() <= 0.27 + 1e-6
    with pytest.raises(LensError, match="no printable pair"):
        made(limits=Limits(min_diameter_nm=290))
    with pytest.raises(DomainError, match=r"holds 0\.93 um"):
        made(library=dataclasses.replace(library(), wavelength_um=np.array([0.93])))


def test_a_lens_of_two_sizes_is_kept_drawn_and_refused_where_one_size_is_known(
    two, tmp_path
):
    made_lens, _ = two
    lens.save(tmp_path / "lens.h5", made_lens)
    again = lens.load(tmp_path / "lens.h5")
    for light in ("x", "y"):
        assert np.array_equal(
            again.for_polarization(light).phase_rad(),
            made_lens.for_polarization(light).phase_rad(),
        )
        assert (
            again.for_polarization(light).sensor_distance_um
            == made_lens.for_polarization(light).sensor_distance_um
        )
    assert again.for_polarization("y").for_polarization("x").sensor_distance_um == 37.0
    with pytest.raises(LensError, match="of two sizes"):
        lens.load_plain(tmp_path / "lens.h5")
    with pytest.raises(DomainError, match="no proxy of one diameter"):
        again.proxy.phase_rad(np.array([0.2]), WAVELENGTH)
    with pytest.raises(LensError, match="two sizes"):
        dataclasses.replace(again, pairs=None)


def test_targets_are_checked():
    from metalens.commands.design import YPolarizationTarget

    with pytest.raises(ConfigError, match=r"along_y\.map"):
        YPolarizationTarget(profile="map")
