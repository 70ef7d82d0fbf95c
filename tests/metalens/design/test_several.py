"""Pillars for several wavelengths: against all diameters tried one by one, and against
plain sums of their light.
"""

import json
import math

import numpy as np
import pytest

from metalens import cli, design
from metalens.cell import Cell, Index
from metalens.core.errors import DomainError, LensError
from metalens.design import Focus, Limits, WavelengthTarget
from metalens.library import Proxy
from tests.command_line import call

CELL = Cell(0.35, 0.9, Index(2.4), Index(1.45))
LIMITS = Limits(90, 60)
SPAN = 0.09, 0.29  # of what the process prints
BLUE, GREEN, RED = 0.50, 0.55, 0.61


def proxy(level=((0.9, 0.06), (0.03, 0.0))):
    """2.6 to 3.3 turns over the diameters, fewer at longer wavelengths, of a curve that
    bends.
    """
    phase = np.array([[0.5, 9.3, 0.7], [-0.8, -1.2, 0.35], [0.1, 0.2, 0.0]])
    return Proxy(phase, np.array(level), (0.08, 0.3), (BLUE, RED), 0.0, 0.0)


def wanted(*focuses, weights=(1.0, 1.0, 1.0)):
    return [
        WavelengthTarget(design.phase_of(None, focus, radius_um=5.0), focus, weight)
        for focus, weight in zip(focuses, weights, strict=False)
    ]


def made(lights, given=None, **about):
    return design.assign_multi_wavelength(
        lights,
        **{
            "aperture_um": 10.0,
            "cell": CELL,
            "proxy": given or proxy(),
            "limits": LIMITS,
        }
        | about,
    )


ACHROMATIC = [Focus(wave, 31.0, 900.0) for wave in (GREEN, BLUE, RED)]


@pytest.fixture(scope="module")
def three():
    return made(wanted(*ACHROMATIC, weights=(1.0, 2.5, 0.7)))


def answers(diameter_um, focuses):
    """(l, ...) t of pillars."""
    p = proxy()
    return np.stack(
        [
            p.transmission(diameter_um, f.wavelength_um)
            * np.exp(1j * p.phase_rad(diameter_um, f.wavelength_um))
            for f in focuses
        ]
    )


def paths(lens, focus):
    """(pillar,) diameters that stand, and their paths to the focus and from the source,
    um.
    """
    d = lens.diameters
    y, x = np.meshgrid(d.y_um, d.x_um, indexing="ij")
    stand = d.diameter_um > 0
    near, far = (
        np.hypot(np.hypot(x, y), z)[stand]
        for z in (focus.sensor_distance_um, focus.source_distance_um)
    )
    return d.diameter_um[stand].astype(float), near, far


def test_no_other_diameter_and_no_other_piston_lowers_the_sum_over_wavelengths(three):
    """All of 20 001 diameters tried at every site: the sum of one step of that grid is
    within 1e-6 of the least.
    """
    lens, _ = three
    weights = np.array([1.0, 2.5, 0.7])
    size, _, _ = paths(lens, ACHROMATIC[0])
    phases = []
    for focus in ACHROMATIC:
        _, near, far = paths(lens, focus)
        phases.append(-2 * np.pi / focus.wavelength_um * (near + far))
    t = answers(size, ACHROMATIC)
    # the best for these pillars
    pistons = np.angle((t * np.exp(-1j * np.array(phases))).sum(1))
    goal = np.exp(1j * (np.array(phases) + pistons[:, None]))
    found = weights @ abs(t - goal) ** 2
    every = answers(np.linspace(*SPAN, 20_001), ACHROMATIC)
    least = np.array(
        [(weights @ abs(every - one[:, None]) ** 2).min() for one in goal.T]
    )
    # pistons settled to 1e-3 rad: 1e-3 times the slope of a sum, about 2
    assert (found - least).max() < 2e-3
    assert (found - least).mean() < 2e-5


def test_quality_at_each_wavelength_is_that_of_its_light_in_the_focus(three):
    """|Σ t exp(ikL)|² over (Σ|t|)²: all light of the pillars in step would be 1."""
    lens, qualities = three
    for focus, quality in zip(ACHROMATIC, qualities, strict=True):
        size, near, far = paths(lens, focus)
        t = answers(size, [focus])[0]
        peak = (
            abs((t * np.exp(2j * np.pi / focus.wavelength_um * (near + far))).sum())
            ** 2
        )
        assert quality.strehl == pytest.approx(peak / np.abs(t).sum() ** 2, rel=1e-5)
        assert quality.wavefront_efficiency == pytest.approx(
            peak / len(t) ** 2, rel=1e-5
        )


def test_what_serves_all_serves_the_others_better_than_a_lens_for_one():
    """23 zones: a phase that all wavelengths share blurs what is 11 % off the design's
    by some two turns.
    """
    lens, qualities = made(wanted(*ACHROMATIC), aperture_um=40.0)
    alone, own = made(wanted(ACHROMATIC[0]), aperture_um=40.0)
    size, near, far = paths(alone, ACHROMATIC[2])
    t = answers(size, ACHROMATIC[2:])[0]
    strehl = (
        abs((t * np.exp(2j * np.pi / RED * (near + far))).sum()) ** 2
        / np.abs(t).sum() ** 2
    )
    # of one wavelength nothing is given up but for |T|, which varies
    assert own[0].strehl > 0.99
    assert strehl < 0.02
    assert min(one.strehl for one in qualities) > 0.25
    assert lens.wavelength_um == GREEN


def test_one_wavelength_and_even_transmission_make_the_wanted_phase():
    """A parabola between steps of 0.05 rad is off by less than 1e-4 rad, diameters in
    float32 by 1e-5.
    """
    lens, (quality,) = made(
        wanted(ACHROMATIC[1]), proxy(level=((0.93, 0.0), (0.0, 0.0)))
    )
    assert quality.max_phase_error_rad < 3e-4
    assert quality.wavefront_efficiency == pytest.approx(0.93**2, rel=1e-6)
    assert (
        lens.diameters.diameter_um[lens.diameters.diameter_um > 0].min()
        >= SPAN[0] - 1e-7
    )


def test_weight_draws_the_compromise():
    near, far = Focus(GREEN, 31.0, math.inf), Focus(RED, 44.0, 700.0)
    even, heavy = (
        made(wanted(near, far, weights=w), aperture_um=40.0)[1]
        for w in ((1.0, 1.0), (1.0, 30.0))
    )
    assert heavy[1].strehl > 0.97 > even[1].strehl > 0.5
    assert heavy[0].strehl < even[0].strehl


def test_two_wavelengths_meet_at_distances_of_their_own():
    near, far = Focus(GREEN, 31.0, math.inf), Focus(RED, 44.0, 700.0)
    lens, qualities = made(wanted(near, far), aperture_um=40.0)
    assert (lens.wavelength_um, lens.sensor_distance_um, lens.source_distance_um) == (
        GREEN,
        31.0,
        math.inf,
    )
    found = design.check_focus(lens, expected=qualities[0].strehl)
    assert found.passed
    # weights of the paths' lengths
    assert found.figures.strehl == pytest.approx(qualities[0].strehl, abs=0.02)


@pytest.mark.parametrize(
    ("lights", "error", "word"),
    [
        ([], LensError, "one or more"),
        (wanted(ACHROMATIC[0], ACHROMATIC[0]), LensError, "each once"),
        (wanted(*ACHROMATIC, weights=(1.0, 0.0, 1.0)), LensError, "above 0"),
        (wanted(ACHROMATIC[0], Focus(0.7, 31.0)), DomainError, "0.7"),
    ],
)
def test_what_cannot_be_made_is_refused_by_name(lights, error, word):
    with pytest.raises(error, match=word):
        made(lights)


DESIGN = """aperture_mm = 0.012
wavelength_nm = 850.0
sensor_distance_mm = 0.03
source_distance_mm = 2.0
[cell]
pitch_um = 0.36
height_um = 0.6
pillar = {n = 3.4}
[limits]
min_diameter_nm = 90.0
[[wavelengths]]
wavelength_nm = 910.0
weight = 1.5
"""


def test_the_command_tells_what_every_wavelength_gets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d.toml").write_text(DESIGN)
    code = call("design d.toml -o lens.h5 --json")
    told = json.loads(capsys.readouterr().out)
    (other,) = told["wavelengths"]
    assert (other["wavelength_nm"], other["weight"]) == (910.0, 1.5)
    assert code == (0 if told["focus_passed"] and other["focus_passed"] else 1)
    for one in (told, other):
        assert one["psf_strehl"] == pytest.approx(one["strehl"], abs=0.03)
    for profile, words in (("fisher", "'fisher' is of one"), ("map", "needs a table")):
        (tmp_path / "d.toml").write_text(f'profile = "{profile}"\n{DESIGN}')
        assert call("design d.toml -o other.h5") == cli.BAD_INPUT
        assert words in capsys.readouterr().err
