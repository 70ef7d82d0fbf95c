"""Films around the lens: against plane waves through the stack, and the engine against
its own exact sum.

Error budget of the exact sum against plane waves: the lattice of the referee folds back
what leaves it (below 1e-3 of
the field), and the mean of s and p power stands for both, 5e-3 of the PSF at the faces
used here. Point by point it is
the sum of all plane waves to 1e-9 (:mod:`tests.metalens.lens.test_waves`).
"""

import dataclasses

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.cell import Film, Index
from metalens.core.errors import PropagationError
from metalens.optics import Layers, Media, media
from metalens.propagate import PropagationCase
from metalens.propagate.paths import chief_path, from_source, to_sensor
from tests.referees import films as referee

WAVELENGTH, PITCH, DISTANCE = 0.85, 0.35, 150.0
BEHIND = (Film(Index(1.52), 55.0), Film(Index(2.1), 7.0))
LAYERS = Layers(front=(Film(Index(1.45), 120.0),), behind=BEHIND, cover=Index(1.31))
GEOMETRY = dict(
    pitch_um=PITCH,
    wavelength_um=WAVELENGTH,
    sensor_distance_um=DISTANCE,
    depths_um=[1000.0, 1340.0, 1800.0],
    window_um=16.0,
    samples=20,
    layers=LAYERS,
)


def lens(case, shape=(92, 96), seed=0):
    """Maps that bring a source at 1340 um, seen where the case looks, to the middle of
    its window; not quite round.
    """
    random = np.random.default_rng(seed)
    y, x = ((np.arange(n) - (n - 1) / 2) * PITCH for n in shape)
    path = from_source(case, x, y[:, None], case.tangents, 1 / 1340.0) + to_sensor(
        case, x, y[:, None]
    )
    level = (np.hypot(x + 0.6, 1.1 * y[:, None]) <= 15.5) * random.uniform(
        0.7, 1.0, shape
    )
    return -case.wavenumber * path + random.normal(0, 0.2, shape), level


@pytest.mark.parametrize("angle_rad", [0.0, (0.3, -0.2)])
def test_the_exact_sum_is_that_of_plane_waves_through_the_stack(angle_rad):
    case = propagate.make_case(
        (92, 96),
        **GEOMETRY
        | dict(
            depths_um=np.inf,
            angle_rad=angle_rad,
            layers=dataclasses.replace(LAYERS, front=()),
        ),
    )
    phase, level = lens(case)
    y, x = case.pillars_um
    incident = np.exp(
        1j * case.wavenumber * from_source(case, x, y[:, None], case.tangents, 0.0)
    )
    stack = referee.Stack(
        [(1.31, DISTANCE - 62.0), (1.52, 55.0), (2.1, 7.0)],
        wavelength=WAVELENGTH,
        step=PITCH,
        count=900,
    )
    waves = stack.fields(level * np.exp(1j * phase) * incident, at=case.centre_um)
    want = (np.abs(waves) ** 2).mean(0)
    middle = stack.count // 2
    near = slice(middle - 9, middle + 9)
    axis = (np.arange(stack.count) - (stack.count - 1) / 2)[near] * PITCH
    points = np.stack(
        np.meshgrid(axis + case.centre_um[0], axis + case.centre_um[1]), -1
    ).reshape(-1, 2)
    got = np.abs(propagate.field_at(phase, level, case, points)[0].reshape(18, 18)) ** 2
    # energies count: nothing is normalised
    assert np.linalg.norm(got - want[near, near]) < 3e-3 * np.linalg.norm(
        want[near, near]
    )


def test_the_exact_sum_of_few_pillars_close_to_the_sensor_is_that_of_all_plane_waves():
    """25 um away, where a ray by itself errs by 1e-3; each pillar by an integral over
    its plane waves.
    """
    near = Layers(
        behind=(Film(Index(1.52), 11.0), Film(Index(2.1), 3.0)), cover=Index(1.0)
    )
    about = GEOMETRY | dict(sensor_distance_um=25.0, layers=near, depths_um=np.inf)
    case = propagate.make_case((3, 4), **about, angle_rad=(0.3, -0.2))
    phase, level = np.zeros((3, 4)), np.zeros((3, 4))
    level[2, 1], level[0, 3], phase[0, 3] = 0.7, 0.9, 0.4
    y, x = case.pillars_um
    points = np.array([[10.0, -3.0], [0.0, 0.2], [4.0, -9.5]])
    want = np.zeros(3, complex)
    for i, j in ((2, 1), (0, 3)):
        light = level[i, j] * np.exp(
            1j
            * (
                phase[i, j]
                + case.wavenumber * from_source(case, x[j], y[i], case.tangents, 0.0)
            )
        )
        reach = np.hypot(points[:, 0] - x[j], points[:, 1] - y[i])
        want += (
            light
            * PITCH**2
            * referee.point_wave(
                case.behind.layers, (1.0, 1.52, 2.1), wavelength=0.85, reach=reach
            )
        )
    assert propagate.field_at(phase, level, case, points)[0] == pytest.approx(
        want, rel=1e-9
    )
    stack = psf.psf_stack(phase, level, **about, angle_rad=(0.3, -0.2), integrate=False)
    # steep rays through thin films are known to that
    assert 4e-12 <= stack.error < 1e-7


# cover, films, distance, angle, window beside the chief ray: what s and p make of a PSF
# is 2e-7 to 2e-3 of it
BEHIND_STACKS = [
    (1.33, ((1.87, 9.0), (1.12, 21.0)), 68.0, (0.21, -0.2), (0.7, -0.4)),
    (1.0, ((1.61, 12.0),), 35.0, 0.0, (9.0, -4.0)),  # beside the light
    (
        1.0,
        ((1.85, 9.0), (1.53, 10.0), (2.12, 3.0)),
        26.0,
        (0.35, 0.3),
        (0.2, 1.1),
    ),  # steep rays through a thin gap
    (1.0, ((2.3, 40.0),), 210.0, (-0.1, 0.3), (1.5, 0.3)),
]


@pytest.mark.parametrize(
    ("cover", "behind", "distance", "angle_rad", "offset"), BEHIND_STACKS
)
def test_the_error_of_a_scalar_behind_films_is_told(
    cover, behind, distance, angle_rad, offset
):
    """Against s and p light of every pillar by its own plane waves: 115 random ones lay
    at 1.2 to 6.7 times it.
    """
    layers = Layers(
        behind=tuple(Film(Index(n), t) for n, t in behind), cover=Index(cover)
    )
    about = dict(
        pitch_um=0.47,
        wavelength_um=WAVELENGTH,
        sensor_distance_um=distance,
        depths_um=np.inf,
        layers=layers,
    )
    about |= dict(angle_rad=angle_rad, offset_um=offset, window_um=4.2, samples=7)
    case = propagate.make_case((34, 39), **about)
    y, x = case.pillars_um
    level = (np.hypot(x, y[:, None]) < 8.0) * np.random.default_rng(3).uniform(
        0.7, 1, (34, 39)
    )
    incident = case.wavenumber * from_source(case, x, y[:, None], case.tangents, 0.0)
    middle = case.centre_um[0] - offset[0], case.centre_um[1] - offset[1]
    phase = -incident - 0.9 * case.wavenumber * to_sensor(case, x, y[:, None], middle)
    light = (level * np.exp(1j * (phase + incident))).ravel()
    at = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    wy, wx = case.window_um
    points = np.stack(
        np.meshgrid(wx + case.centre_um[0], wy + case.centre_um[1]), -1
    ).reshape(-1, 2)
    order = (cover, *(n for n, _ in behind))
    media_um = [(cover, distance - sum(t for _, t in behind)), *behind]
    both = referee.sums(
        light[light != 0], at[light != 0], points, media_um, order, WAVELENGTH
    )
    want = (np.abs(both) ** 2).sum(0).reshape(7, 7)
    want /= want.sum()
    got = psf.psf_stack(phase, level, **about, integrate=False, tolerance=1e-8)
    error = np.linalg.norm(got.intensity[0] - want) / np.linalg.norm(want)
    assert 1e-8 < error < got.budget.total < 5 * error


def test_a_source_behind_a_film_has_the_phase_of_its_plane_waves():
    tangents, depth = (0.21, -0.11), 1340.0
    case = propagate.make_case(
        (90, 90),
        **GEOMETRY | dict(depths_um=depth, angle_rad=tuple(np.arctan(tangents))),
    )
    sine = np.hypot(*tangents) / np.sqrt(1 + np.hypot(*tangents) ** 2)
    foot = (
        media.lateral_reach(Media((1.0, 1.45), (depth - 120.0, 120.0)), sine)
        * np.array(tangents)
        / np.hypot(*tangents)
    )
    x = np.array([0.4, -7.0, 12.0, 3.0])
    y = np.array([1.2, 5.5, -9.0, 14.0])
    radii = np.hypot(x + foot[0], y + foot[1])
    want = referee.source_phase(
        [(1.0, 0.0), (1.45, 120.0)], depth, np.hypot(*foot), radii, WAVELENGTH
    )
    got = case.wavenumber * from_source(case, x, y, tangents, 1 / depth)
    # change of the next term, 1/(k z), over 15 um of 1.3 mm: 1e-6; quadrature 1e-5
    assert np.abs(np.angle(np.exp(1j * (got - want)))).max() < 1e-4


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_the_engine_meets_its_tolerance_through_films(tolerance):
    geometry = GEOMETRY | dict(angle_rad=(0.3, -0.2))
    phase, level = lens(propagate.make_case((92, 96), **geometry))
    maps = torch.tensor(phase, requires_grad=True), torch.tensor(level)
    stack = psf.psf_stack(*maps, tolerance=tolerance, **geometry)
    want = np.abs(propagate.exact(phase, level, **geometry)) ** 2
    want /= want.sum((-1, -2), keepdims=True)
    error = np.linalg.norm(stack.numpy().intensity - want) / np.linalg.norm(want)
    assert error <= stack.error <= tolerance
    assert stack.error <= 3 * error + 2e-12


def test_films_of_the_index_around_them_change_nothing():
    plain = {
        name: value for name, value in GEOMETRY.items() if name != "layers"
    } | dict(angle_rad=(0.1, 0.25))
    phase, level = lens(propagate.make_case((92, 96), **plain))
    of_air = Layers(front=(Film(Index(1.0), 30.0),), behind=(Film(Index(1.0), 20.0),))
    one, other = (
        propagate.exact(phase, level, **plain, layers=layers)
        for layers in (None, of_air)
    )
    assert abs(one - other).max() < 1e-9 * np.abs(one).max()
    windows = [
        psf.psf_stack(phase, level, tolerance=1e-8, **plain, layers=s).intensity
        for s in (None, of_air)
    ]
    assert abs(windows[0] - windows[1]).max() < 1e-8 * windows[0].max()


def test_a_source_at_infinity_is_the_limit_of_far_ones():
    case = propagate.make_case(
        (90, 90), **GEOMETRY | dict(depths_um=[1e9, np.inf], angle_rad=(0.2, 0.1))
    )
    x, y = np.array([3.0, -11.0]), np.array([7.0, 2.0])
    near, far = (
        from_source(case, x, y, case.tangents, v) for v in case.inverse_depths_per_um
    )
    assert near == pytest.approx(far, abs=2e-7)  # r² / 2z
    assert far == pytest.approx(
        (x * case.tangents[0] + y * case.tangents[1])
        / np.sqrt(1 + np.hypot(*case.tangents) ** 2)
    )


def test_films_that_do_not_fit_are_refused_by_name():
    thick = Layers(behind=(Film(Index(1.5), DISTANCE + 1),))
    with pytest.raises(
        PropagationError,
        match="layers: films of 151 um in the 150 um from lens to sensor",
    ):
        propagate.make_case((9, 9), **GEOMETRY | dict(layers=thick))
    with pytest.raises(
        PropagationError,
        match="layers: films of 1200 um in the 1000 um from source to lens",
    ):
        propagate.make_case(
            (9, 9), **GEOMETRY | dict(layers=Layers(front=(Film(Index(1.5), 1200.0),)))
        )
    with pytest.raises(PropagationError, match="absorb"):
        propagate.make_case(
            (9, 9),
            **GEOMETRY | dict(layers=Layers(behind=(Film(Index(1.5, 0.2), 3.0),))),
        )


def test_chief_ray_and_its_path_obey_snell():
    case = propagate.make_case((9, 9), **GEOMETRY | dict(angle_rad=(0.4, 0.0)))
    sine = np.sin(0.4)
    angles = [np.arcsin(sine / n) for n in (1.31, 1.52, 2.1)]
    thick = (DISTANCE - 62.0, 55.0, 7.0)
    assert case.centre_um[0] == pytest.approx(
        sum(t * np.tan(a) for t, a in zip(thick, angles, strict=True)), rel=1e-12
    )
    length = sum(
        n * t / np.cos(a)
        for n, t, a in zip((1.31, 1.52, 2.1), thick, angles, strict=True)
    )
    assert chief_path(case) == pytest.approx(length, rel=1e-12)
    assert isinstance(case, PropagationCase)
