"""Ranges that follow a lens: closed forms of paraxial defocus, in air and through
films.
"""

import dataclasses

import numpy as np
import pytest

from metalens.cell import Cell, Film, Index
from metalens.lens import DiameterMap, Lens, reach
from metalens.optics import Layers, Stop
from tests.proxies import proxy_of

PROXY = proxy_of([3.0, 2.8, 0.3], [0.9, 0.05], (0.1, 0.3), 0.85)


def lens(sites=2501, source_um=20e3, sensor_um=3000.0, layers=None, cover="air"):
    """One row of pillars, 1 mm wide at 2501 sites of 0.4 um."""
    diameters = DiameterMap(np.full((1, sites), 0.2), 0.4)
    return Lens(
        diameters,
        Cell(0.4, cover=cover),
        PROXY,
        0.85,
        sensor_um,
        source_um,
        "map",
        layers=layers or Layers(),
    )


def test_an_eye_tracker_of_a_millimetre_looks_from_16_to_26_mm():
    assert reach.depth_range_um(lens()) == (16e3, 26e3)


@pytest.mark.parametrize("source_um", [8e3, 37e3])
def test_both_ends_are_as_far_out_of_focus(source_um):
    made = lens(source_um=source_um)
    near, far = reach.depth_range_um(made, digits=9)
    waves = [
        abs(np.hypot(500.0, z) - z - np.hypot(500.0, source_um) + source_um) / 0.85
        for z in (near, far)
    ]
    # the next term: (R / 2z)² of it
    assert waves == pytest.approx([1.75, 1.75], rel=0.02)
    assert near < source_um < far


def test_a_lens_for_infinity_looks_from_where_it_blurs_to_ten_times_that():
    near, far = reach.depth_range_um(lens(source_um=np.inf), digits=6)
    assert near == pytest.approx(500.0**2 / (2 * 1.75 * 0.85), rel=1e-5)
    assert far == pytest.approx(10 * near, rel=1e-5)


def test_a_lens_of_few_pillars_looks_no_nearer_than_its_width():
    near, far = reach.depth_range_um(lens(sites=21, source_um=1e3), digits=6)
    assert near == pytest.approx(8.0)
    assert far == pytest.approx(80.0)


def test_films_count_as_the_air_that_bends_light_as_much():
    glass = Layers(front=(Film(Index(1.5), 900.0),), behind=(Film(Index(2.0), 600.0),))
    made = lens(layers=glass, cover=Index(1.25))
    assert reach.sensor_reach_um(made) == pytest.approx(2400 / 1.25 + 300)
    assert reach.diffraction_um(made) == pytest.approx(0.85 * (2400 / 1.25 + 300) / 500)
    assert reach.defocus_per_um(made, 15e3) == pytest.approx(
        1 / 14.7e3 - 1 / 19.7e3, rel=1e-12
    )
    assert reach.blur_um(made, 15e3) == pytest.approx(
        500 * 2220 * (1 / 14.7e3 - 1 / 19.7e3), rel=1e-12
    )
    near, far = reach.depth_range_um(made, digits=9)
    bare = dataclasses.replace(lens(), source_distance_um=19.7e3)
    assert (near - 300, far - 300) == pytest.approx(
        reach.depth_range_um(bare, digits=9), rel=1e-8
    )


def test_a_lens_yet_to_be_made_reaches_as_it_will():
    made = lens(source_um=37e3)
    wanted = reach.ApertureSummary(made.diameters.radius_um, 0.85, 3000.0, 37e3)
    for of in (reach.depth_range_um, reach.disc_um, reach.diffraction_um):
        assert of(made) == of(wanted)
    assert reach.blur_um(made, 8e3) == reach.blur_um(wanted, 8e3)


@pytest.mark.parametrize(("depth_um", "radius_um"), [(16e3, 500.0), (9e3, 410.0)])
def test_a_step_of_depth_moves_the_rim_by_an_eighth_of_a_wave(depth_um, radius_um):
    step = reach.depth_step_um(
        reach.ApertureSummary(radius_um, 0.85, 2000.0, 20e3), depth_um
    )
    waves = [(np.hypot(radius_um, z) - z) / 0.85 for z in (depth_um, depth_um + step)]
    # 2 digits; and the step's second order, 1.3 %
    assert waves[0] - waves[1] == pytest.approx(0.115, rel=0.05)


def test_samples_show_the_finest_detail_of_any_lens():
    """wavelength / 4 sin of the rim's angle is the coarsest that holds an intensity's
    band; a quarter of a pixel.
    """
    for radius, sensor in ((2100.0, 1700.0), (310.0, 900.0), (55.0, 2000.0)):
        found = reach.sample_um(reach.ApertureSummary(radius, 0.633, sensor, 5e3), 4.3)
        limit = 0.633 / (4 * radius / np.hypot(radius, sensor))
        assert found <= min(limit, 1.05 * 4.3 / 4)
        assert found >= 0.8 * min(limit, 4.3 / 4)


def test_a_stop_in_front_leaves_the_part_of_a_lens_that_it_lights():
    """A hole of 200 um, 1200 um before the pillars: a source at 20 mm lights 200 · 20 /
    18.8 um; one of 700 um: all.
    """
    made = lens(layers=Layers(stop=Stop(200.0, 1200.0)))
    lit = 200 * 20 / 18.8
    airy = 0.85 * 3000 / lit
    assert reach.diffraction_um(made) == pytest.approx(airy, rel=1e-12)
    assert reach.blur_um(made, 15e3) == pytest.approx(
        lit * 3000 * (1 / 15e3 - 1 / 20e3), rel=1e-12
    )
    assert reach.disc_um(made) == float(f"{5.3 * airy:.2g}")
    assert reach.pixel_um(made) == float(f"{0.88 * airy:.2g}")
    # 0.23 · 0.85 (2000 / 212.77)² = 17.27
    assert reach.depth_step_um(made, 2e3) == 17.0
    assert reach.depth_step_um(made, 9e3) == 180.0  # a fiftieth of the depth; 349.8
    near, far = reach.depth_range_um(made, digits=9)
    assert 1 / near - 1 / 20e3 == pytest.approx(2 * 1.75 * 0.85 / lit**2, rel=1e-7)
    assert far == pytest.approx(10 * near, rel=1e-7)  # 1/20e3 is less than that
    whole = lens(layers=Layers(stop=Stop(700.0, 1200.0)))
    assert (
        reach.diffraction_um(whole)
        == reach.diffraction_um(lens())
        == pytest.approx(0.85 * 3000 / 500)
    )
    assert reach.blur_um(whole, 15e3) == reach.blur_um(lens(), 15e3)


def test_a_window_holds_the_worst_blur_or_the_rings():
    made = lens()
    assert reach.window_um(made, (19e3, 25e3, 21e3), airy=9.0) == float(
        f"{8 * 500 * 3000 * (1 / 20e3 - 1 / 25e3):.3g}"
    )
    assert reach.window_um(made, (19.9e3, 20.1e3), airy=9.0) == float(
        f"{9 * 0.85 * 6:.3g}"
    )
    # a pitch
    assert reach.diffraction_um(lens(sites=1)) == pytest.approx(0.85 * 3000 / 0.4)
