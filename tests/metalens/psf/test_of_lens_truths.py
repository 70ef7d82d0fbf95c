"""What a lens's PSF stack is made of, with typed stacks: mean of polarisations, cones
of rays, worst directions.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.ground.store import Provenance
from metalens.lens import Layers
from metalens.pillars import Proxy
from metalens.psf import of_lens
from metalens.psf.budget import Budget
from metalens.psf.record import PsfStack
from metalens.psf.spectrum import Nodes, Source

RNG = np.random.default_rng(3)


def proxy(knows_angles):
    """|T| = 0.8 everywhere, 4e-3 rad and 6e-3 off."""
    phase, level = np.array([[1.0, 2.0]]), np.array([[0.8]])
    if knows_angles:
        phase, level = phase[None], level[None]
    return Proxy(phase, level, (0.1, 0.3), (0.84, 0.86), 4e-3, 6e-3, 1, knows_angles)


def lens(knows_angles=0.0):
    return SimpleNamespace(
        layers=Layers(),
        sensor_distance_um=700.0,
        wavelength_um=0.85,
        diameters=SimpleNamespace(
            radius_um=200.0, pitch_um=0.4, pillars=700_000, site_um2=0.16
        ),
        proxy=proxy(knows_angles),
        hand="",
        pairs=None,
        one_light="",
    )


def stack(angle, error, energy):
    light = RNG.uniform(0.2, 1.0, (1, 2, 3, 4)).astype(np.float32)
    return PsfStack(
        light / light.sum((-1, -2), keepdims=True),
        np.array([energy], np.float32),
        depths_um=np.array([2e3, 5e3]),
        angles_rad=np.array([angle]),
        wavelengths_um=np.array([0.85]),
        weights=np.ones(1),
        step_um=0.6,
        centres_um=np.array([[1.0, 2.0]]) * (1 + angle[0]),
        sensor_distance_um=700.0,
        tolerance=1e-3,
        error=error,
        reason=f"error {error:g}",
    )


def test_light_without_polarisation_is_the_mean_irradiance_of_both():
    """Shares of sum 1 are weighed by their light: 3 and 9 um² of one and 5 and 3 of the
    other; the worse error.
    """
    x, y = stack((0.0, 0.0), 2e-4, (3.0, 9.0)), stack((0.0, 0.0), 7e-4, (5.0, 3.0))
    made = of_lens.unpolarised(x, y)
    assert made.energy_um2 == pytest.approx(np.array([[4.0, 6.0]]))
    for k, (a, b) in enumerate(((3, 5), (9, 3))):
        want = (a * x.intensity[0, k] + b * y.intensity[0, k]) / (a + b)
        assert made.intensity[0, k] == pytest.approx(want, rel=1e-5)
    assert made.error == 7e-4
    assert made.intensity.dtype == np.float32


def test_the_aperture_is_half_the_spread_of_sines_seen_from_the_chief_rays_place():
    """On the axis the sine of the rim; at an angle of rays in the plane of incidence,
    whatever its azimuth.
    """
    edge = 200.2
    assert of_lens.aperture(lens(), (0.0, 0.0)) == pytest.approx(
        edge / math.hypot(edge, 700), rel=1e-9
    )
    for angle in ((0.3, 0.0), (0.0, -0.3), (0.2, -0.15)):
        reach = 700 * math.hypot(math.tan(angle[0]), math.tan(angle[1]))
        sines = [
            (reach + s * edge) / math.hypot(reach + s * edge, 700) for s in (1, -1)
        ]
        assert of_lens.aperture(lens(), angle) == pytest.approx(
            (sines[0] - sines[1]) / 2, rel=1e-9
        )


def test_pillars_are_asked_at_the_angle_of_both_slopes_where_they_know_angles():
    want = math.atan(math.hypot(math.tan(0.2), math.tan(-0.15)))
    assert of_lens.incidence(lens(0.5), (0.2, -0.15)) == pytest.approx(want)
    assert of_lens.incidence(lens(), (0.2, -0.15)) == 0.0


def test_directions_are_joined_in_their_order_with_the_worst_error_and_its_reason():
    parts = [
        stack((0.0, 0.1), 2e-4, (1.0, 2.0)),
        stack((0.2, 0.0), 9e-4, (3.0, 4.0)),
        stack((0.3, 0.0), 4e-4, (5.0, 6.0)),
    ]
    made = of_lens._joined(parts, Provenance())
    assert made.energy_um2.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert made.angles_rad[:, 0].tolist() == [0.0, 0.2, 0.3]
    assert made.centres_um[:, 1] == pytest.approx([2.0, 2.4, 2.6])
    assert (made.error, made.reason) == (9e-4, "error 0.0009")
    assert made.intensity.shape == (3, 2, 3, 4)


def test_obliquity_is_uneven_over_the_aperture_by_1_over_cos():
    """Against a fine lattice over the disc, in air: √(r² + d²) / d from the chief ray's
    place; 0 for a narrow lens.
    """
    edge = 200.2
    x, y = np.meshgrid(*2 * [(np.arange(801) - 400) / 400 * edge])
    disc = np.hypot(x, y) <= edge
    for angle in ((0.0, 0.0), (0.3, 0.0), (0.2, -0.15)):
        cx, cy = (700 * math.tan(a) for a in angle)
        steep = np.sqrt((cx - x[disc]) ** 2 + (cy - y[disc]) ** 2 + 700.0**2) / 700
        assert of_lens.uneven(lens(), angle) == pytest.approx(
            steep.std() / steep.mean(), rel=3e-3
        )


def test_a_direction_s_budget_has_its_own_cone_and_incidence(monkeypatch):
    asked = {}
    monkeypatch.setattr(
        of_lens,
        "with_model",
        lambda budget, **about: asked.update(about, budget=budget) or budget,
    )
    part = dataclasses.replace(
        stack((0.2, -0.15), 2e-4, (1.0, 2.0)), budget=Budget(1e-4, sampling=2e-4)
    )
    nodes = Nodes(np.array([0.84, 0.87]), np.array([0.3, 0.7]), 0.013)
    of_lens._budget(lens(), (0.2, -0.15), part, nodes, "vector", "rough")
    assert asked["light"] == (nodes.wavelengths_um, nodes.weights)
    assert asked["budget"] == Budget(1e-4, sampling=2e-4, spectrum=0.013)
    assert asked["aperture"] == pytest.approx(of_lens.aperture(lens(), (0.2, -0.15)))
    assert asked["uneven"] == pytest.approx(of_lens.uneven(lens(), (0.2, -0.15)))
    assert asked["incidence_rad"] == pytest.approx(
        math.atan(math.hypot(math.tan(0.2), math.tan(-0.15)))
    )
    assert (asked["polarisation"], asked["has_angles"], asked["left_out"]) == (
        "vector",
        False,
        "rough",
    )
    assert asked["ghost"] == lens().layers.ghost(0.85)
    assert asked["lit"] == pytest.approx(700_000 * 0.16 / 0.85**2, rel=1e-12)
    assert asked["proxy"] == pytest.approx(8.5e-3, rel=1e-12)  # 4e-3 and 6e-3 / 0.8


@pytest.mark.parametrize(
    ("tolerance", "spectrum", "left", "dtype"),
    [
        (1.7e-3, 8e-4, 1.5e-3, "float32"),
        (
            1.7e-3,
            1.5e-3,
            8.5e-4,
            "float32",
        ),  # 0.8e-3 would be left: half of it all is kept
        (1.7e-3, 0.3, 8.5e-4, "float32"),
        (1.0e-6, 0.0, 1.0e-6, "float32"),
        (0.9e-6, 0.0, 0.9e-6, "float64"),
    ],
)
def test_sums_get_what_the_spectrum_s_error_leaves_of_the_tolerance(
    monkeypatch, tolerance, spectrum, left, dtype
):
    """Errors that know nothing of each other add in squares: 8² + 15² = 17². What is
    left is never below a half, since
    no sum can make up for a spectrum; single precision rounds to 1e-7 and serves from
    1e-6 on."""
    asked = []

    def summed(phase, level, **about):
        asked.append(
            (
                phase,
                about["tolerance"],
                about["wavelength_um"],
                about["weights"],
                about["angle_rad"],
            )
        )
        return SimpleNamespace(
            numpy=lambda: stack(tuple(about["angle_rad"][0]), 2e-4, (1.0, 2.0))
        )

    made, nodes = lens(), Nodes(np.array([0.84, 0.87]), np.array([0.3, 0.7]), spectrum)
    made.diameters.grid = SimpleNamespace(_asdict=dict)
    made.neighbours = None
    monkeypatch.setattr(of_lens, "psf_stack", summed)
    monkeypatch.setattr(
        of_lens,
        "all_maps",
        lambda lens, nodes, angle, dtype, scalar: ((str(dtype), None), None),
    )
    monkeypatch.setattr(of_lens, "_budget", lambda *_: Budget(2e-4))
    view = of_lens.View((2e3, 5e3), ((0.0, 0.1), (0.2, 0.0)))
    found = of_lens.from_lens(made, view, tolerance=tolerance, spectrum=nodes)
    assert [one[0] for one in asked] == [f"torch.{dtype}"] * 2
    assert [one[1] for one in asked] == pytest.approx([left] * 2, rel=1e-12)
    assert [one[2:] for one in asked] == [
        ([0.84, 0.87], [0.3, 0.7], [list(angle)]) for angle in view.angles_rad
    ]
    assert found.tolerance == tolerance


def test_the_direction_that_takes_most_wavelengths_says_how_many():
    """Paths of 4, 70 and 30 um across the same light: the second alone asks for as
    many.
    """
    source, light = Source(850.0, 24.0), np.ones((1, 5, 5))
    spans = [np.full((1, 5, 5), path_um) for path_um in (4.0, 70.0, 30.0)]

    def asked(some):
        stack = SimpleNamespace(intensity=[light] * len(some))
        return len(of_lens._asked(source, some, stack, 1e-3).weights)

    assert asked(spans) == asked(spans[1:2]) > asked(spans[2:]) > asked(spans[:1])


@pytest.mark.parametrize(("tolerance", "taken"), [(2e-5, "flux"), (1e-3, "scalar")])
def test_light_counts_as_a_scalar_where_that_is_within_the_tolerance(tolerance, taken):
    """NA 0.27, where both polarisations change some 1e-4: (NA / 0.24)⁴ of 7e-5."""
    assert of_lens._counted(lens(), (0.0, 0.0), "auto", tolerance) == taken
    assert of_lens._counted(lens(), (0.0, 0.0), "vector", tolerance) == "vector"
