"""Parts of a chief ray: guesses and fits of known phases, media by differences, lenses
turned on their side.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from metalens.aberrations import chief
from metalens.aberrations.chief import chief_ray
from metalens.cell import Cell, Film, Index, Lattice
from metalens.ground.errors import PropagationError
from metalens.lens import DiameterMap, Layers, Lens, Media, Stop
from tests.metalens.aberrations.hyperbolic import CASES, PITCH, PROXY, WAVE, made

K = 2 * math.pi / WAVE
rng = np.random.default_rng(4)
GLASS = Layers(behind=(Film(Index(1.51), 90.0), Film(Index(1.38), 30.0))).after(
    310.0, WAVE
)
OIL = Media((1.25, 1.51, 1.38), (190.0, 90.0, 30.0))
TERMS = [(i, j) for i in range(5) for j in range(5) if i + j < 5]


def walk(p, gap=190.0, cover=1.0):
    """(2,) X - x of a heading: each medium by its own slope p / √(n² - p²)."""
    w = p @ p
    return sum(
        t * p / math.sqrt(n * n - w)
        for n, t in ((cover, gap), (1.51, 90.0), (1.38, 30.0))
    )


@pytest.mark.parametrize("p", [(0.0, 0.0), (0.31, -0.22), (-0.5, 0.62)])
def test_the_walk_of_a_heading_changes_as_its_differences(p):
    p = np.array(p)
    step = 1e-6 * np.eye(2)
    want = np.stack([(walk(p + e) - walk(p - e)) / 2e-6 for e in step], 1)
    assert chief._bent(GLASS, p) == pytest.approx(want, rel=1e-7, abs=1e-5)


@pytest.mark.parametrize(("behind", "cover"), [(GLASS, 1.0), (OIL, 1.25)])
@pytest.mark.parametrize("p", [(0.0, 0.0), (0.31, -0.22), (-0.4, 0.1)])
def test_close_rays_spread_least_at_the_foci_of_either_axis(p, behind, cover):
    """|uᵀ(1 + B Q)| over the gap before the films, which stay; Q of no symmetry but its
    own.
    """
    p, q = np.array(p), -np.array([[1 / 260.0, 3e-4], [3e-4, 1 / 340.0]])

    def spread(z, axis):
        step = 1e-6 * np.eye(2)
        bent = np.stack(
            [
                (walk(p + e, z - 120.0, cover) - walk(p - e, z - 120.0, cover)) / 2e-6
                for e in step
            ],
            1,
        )
        return float(((np.eye(2) + bent @ q)[axis] ** 2).sum())

    want = [minimize_scalar(spread, bounds=(100.0, 700.0), args=(axis,), method="bounded", options={"xatol": 1e-4}).x
            for axis in (0, 1)]  # fmt: skip
    assert chief._foci(behind, p, q) == pytest.approx(
        want, abs=2e-2
    )  # a parabola's least by its values


def test_foci_of_a_thin_lens_are_its_focal_lengths_and_parallel_rays_have_none():
    air = Layers().after(310.0, WAVE)
    assert chief._foci(
        air, np.zeros(2), -np.diag([1 / 260.0, 1 / 400.0])
    ) == pytest.approx([260.0, 400.0], rel=1e-12)
    assert chief._foci(
        air, np.zeros(2), np.diag([1 / 150.0, -1 / 400.0])
    ) == pytest.approx([-150.0, 400.0], rel=1e-12)
    one = chief._foci(air, np.zeros(2), np.diag([-1 / 260.0, 0.0]))
    assert (one[0], one[1]) == (pytest.approx(260.0), math.inf)
    weak = chief._foci(air, np.zeros(2), np.diag([-1e-7 / 310, -1e-9 / 310]))
    assert weak[0] == pytest.approx(310e7, rel=1e-6)
    assert weak[1] == math.inf


def test_changes_are_by_columns():
    got = chief._change(
        lambda x: np.array([x[0] ** 2 + 3 * x[1], math.sin(x[1])]),
        np.array([0.7, 0.4]),
        1e-4,
    )
    assert got == pytest.approx(np.array([[1.4, 3.0], [0.0, math.cos(0.4)]]), abs=1e-8)


@pytest.mark.parametrize(
    ("centred", "shape"),
    [(False, (23, 31)), (False, (31, 22)), (True, (23, 31)), (True, (31, 21))],
)
def test_a_quadratic_phase_is_guessed_to_rounding(centred, shape):
    """About a place beside the middle of the map, of unlike steps; on a hexagon every
    other site holds a pillar.
    """
    steps, off = (0.41, 0.36), (1.3, -0.8)
    x, y = (
        (np.arange(n) - (n - 1) / 2) * s + o
        for n, s, o in zip(shape[::-1], steps, off, strict=True)
    )
    c = {
        (0, 0): 0.7,
        (1, 0): 0.45,
        (0, 1): -0.62,
        (2, 0): 0.011,
        (1, 1): -0.017,
        (0, 2): 0.023,
    }
    phase = sum(v * x**i * y[:, None] ** j for (i, j), v in c.items())
    turn = np.exp(1j * phase)
    if centred:
        turn[(np.arange(shape[0])[:, None] + np.arange(shape[1])) % 2 == 1] = 0
    got = chief._guessed(turn, (x[0] + x[-1], y[0] + y[-1]), steps, centred)
    assert set(got) == {(1, 0), (0, 1), (2, 0), (1, 1), (0, 2)}
    for power, value in got.items():
        assert value == pytest.approx(c[power], rel=1e-9, abs=1e-12)


def test_a_polynomial_of_fourth_degree_is_fitted_from_a_guess_and_what_is_left_is_rms_of_what_is_free():
    """Of 300 pillars 15 coefficients are fitted: Σ left² / 285, by numpy's least
    squares of the noise itself.
    """
    x, y = rng.uniform(-1, 1, (2, 300))
    terms = np.stack([x**i * y**j for i, j in TERMS], -1)
    true = rng.normal(0, 2.0, 15)
    noise = rng.normal(0, 0.15, 300)
    first = dict(zip(TERMS, true + rng.normal(0, 0.05, 15), strict=True))
    del first[0, 0], first[4, 0]
    true[TERMS.index((4, 0))] = 0.2
    series, scatter = chief._fitted(terms, np.exp(1j * (terms @ true + noise)), first)
    fit = np.linalg.lstsq(terms, noise, rcond=None)[0]
    whole = series - true - fit
    assert whole[1:] == pytest.approx(np.zeros(14), abs=1e-9)
    assert np.angle(np.exp(1j * whole[0])) == pytest.approx(0, abs=1e-9)
    assert scatter == pytest.approx(
        math.sqrt(((noise - terms @ fit) ** 2).sum() / 285), rel=1e-9
    )
    few = chief._fitted(terms[:9], np.ones(9, complex), {})[1]
    assert few < 1e-9  # as many as 15 go through nine


def test_curvatures_are_of_the_phase_and_not_of_its_series():
    got = chief._curvature({(2, 0): 0.3, (1, 1): -0.7, (0, 2): 1.1}, 20.0)
    assert got == pytest.approx(np.array([[0.6, -0.7], [-0.7, 2.2]]) / 400.0, rel=1e-12)


def lens_on(lattice, phase, row_um=0.0, count=(150, 170)):
    """Pillars of a phase on a lattice, all over a map."""
    steps = {"rectangular": (PITCH, 0.5 * 1.0), "hexagonal": (PITCH / 2, row_um)}[
        lattice.kind
    ]
    if lattice.kind == "rectangular":
        steps = (PITCH, lattice.ratio * PITCH)
    x, y = (
        (np.arange(n) - (n - 1) / 2) * s
        for n, s in zip(count[::-1], steps, strict=True)
    )
    d = 0.2 + 0.12 * np.mod(phase(x, y[:, None]), 2 * np.pi) / (3 * np.pi)
    if lattice.kind == "hexagonal":
        d = np.where(
            (np.arange(count[0])[:, None] + np.arange(count[1])) % 2 == 0, d, 0.0
        )
    cell = Cell(
        pitch_um=PITCH, pillar=Index(3.6), substrate=Index(1.45), lattice=lattice
    )
    held = DiameterMap(d, PITCH, lattice, steps[1])
    return Lens(held, cell, PROXY, WAVE, 310.0, math.inf, "map")


@pytest.mark.parametrize(
    ("lattice", "row", "count"),
    [
        (Lattice("rectangular", 1.2), 0.0, (201, 261)),
        (Lattice("hexagonal"), 0.364, (301, 533)),
    ],
)
def test_lattices_of_unlike_steps_have_the_ray_of_their_phase(lattice, row, count):
    """An astigmatic lens of 260 and 340 um, twisted: slope and curvature of its phase
    at the middle of the map.
    """
    q = -np.array([[1 / 260.0, 3e-4], [3e-4, 1 / 340.0]])
    slope = np.array([0.04, -0.07])

    def phase(x, y):
        return K * (
            slope[0] * x
            + slope[1] * y
            + q[0, 0] * x * x / 2
            + q[0, 1] * x * y
            + q[1, 1] * y * y / 2
        )

    found = chief_ray(lens_on(lattice, phase, row, count), (0.03, 0.11))
    tangents = np.tan([0.03, 0.11])
    p = tangents / math.sqrt(1 + tangents @ tangents) + slope
    assert found.p == pytest.approx(p, abs=1e-6)
    air = Layers().after(310.0, WAVE)
    assert found.meets_um == pytest.approx(
        found.at_um + 310 * p / math.sqrt(1 - p @ p), abs=1e-3
    )
    assert found.focus_um == pytest.approx(chief._foci(air, p, q), rel=1e-4)
    assert (
        found.focus_error_um.max() < 0.05
    )  # of ideal pillars: their curves between sizes, in single precision


def on_its_side(lens):
    """x and y exchanged, stop and films as they are."""
    held = DiameterMap(np.ascontiguousarray(lens.diameters.diameter_um.T), PITCH)
    stop = lens.layers.stop
    layers = lens.layers if stop is None else dataclasses.replace(
        lens.layers, stop=Stop(stop.radius_um, stop.distance_um, stop.centre_um[::-1]))  # fmt: skip
    return dataclasses.replace(lens, diameters=held, layers=layers)


@pytest.mark.parametrize("case", ["off-centre", "glass", "all", "beside"])
def test_a_lens_on_its_side_has_its_ray_on_its_side(case):
    lens, depth = made(case), CASES[case][1]
    one = chief_ray(lens, (0.13, -0.06), depth)
    other = chief_ray(on_its_side(lens), (-0.06, 0.13), depth)
    for name in ("at_um", "p", "meets_um", "focus_um", "source"):
        assert getattr(other, name)[::-1] == pytest.approx(
            getattr(one, name), rel=1e-6, abs=1e-7
        ), name
    assert other.focus_error_um[::-1] == pytest.approx(one.focus_error_um, rel=1e-3)
    assert other.moves[::-1, ::-1] == pytest.approx(one.moves, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("case", ["off-centre", "glass", "all", "beside"])
def test_the_linear_image_is_that_of_rays_beside(case):
    """Of sources moved along x and along y; the differences of rays of their own fits,
    1e-3 of them.
    """
    lens, depth, angle = made(case), CASES[case][1], np.array([0.13, -0.06])
    found = chief_ray(lens, tuple(angle), depth)
    for e in np.eye(2) * 1e-3:
        ahead, behind = (chief_ray(lens, tuple(angle + s * e), depth) for s in (1, -1))
        landed = ahead.meets_um - behind.meets_um
        assert found.moves @ (ahead.source - behind.source) == pytest.approx(
            landed, abs=2e-3 * np.abs(landed).max()
        )


def test_scattered_phases_have_an_error_of_their_variance():
    """The fit is linear: of noise σ the curvature's covariance is σ² (TᵀT)⁻¹, and a
    focus moves by its rates: over
    twelve draws of 0.1 rad the bars differ by how well σ is known, 2 % each."""
    lens = made("plain")
    clean = chief_ray(lens, (0.05, 0.02))
    bars = np.array(
        [
            chief_ray(
                made("plain", scatter_rad=0.1, seed=s), (0.05, 0.02)
            ).focus_error_um
            for s in range(12)
        ]
    )
    d = lens.diameters
    near = chief.ZONES * math.sqrt(WAVE * 310.0)
    x, y = np.meshgrid(d.x_um - clean.at_um[0], d.y_um - clean.at_um[1])
    inside = (x**2 + y**2 <= near**2) & (d.diameter_um > 0)
    terms = np.stack(
        [(x[inside] / near) ** i * (y[inside] / near) ** j for i, j in TERMS], -1
    )
    cover = 0.01 / K**2 * np.linalg.inv(terms.T @ terms)
    want = []
    for axis, (power, factor) in enumerate((((2, 0), 2.0), ((0, 2), 2.0))):
        sigma = (
            math.sqrt(cover[TERMS.index(power), TERMS.index(power)]) * factor / near**2
        )
        step = 1e-7
        q = -np.eye(2) / 310.0
        moved = q + np.diag([step, 0.0] if axis == 0 else [0.0, step])
        air = Layers().after(310.0, WAVE)
        rate = (
            chief._foci(air, np.zeros(2), moved) - chief._foci(air, np.zeros(2), q)
        )[axis] / step
        want.append(sigma * abs(rate))
    assert bars.mean(0) == pytest.approx(want, rel=0.05)  # oblique by 3 degrees: 1 %


def grating(sine):
    """A plate whose pillars bend light straight on to this sine."""
    lens = made("plain")
    place = lens.diameters.x_um
    turns = np.mod(sine * place / WAVE, 1.0) + np.zeros((len(place), 1))
    even = np.where(lens.diameters.diameter_um > 0, 0.2 + 0.12 * 2 * turns / 3, 0.0)
    return Lens(
        DiameterMap(even, PITCH), lens.cell, lens.proxy, WAVE, 310.0, math.inf, "map"
    )


def test_rays_that_graze_are_lost_from_a_thousandth_of_their_square_on():
    """n sin θ up to √0.999 = 0.9995."""
    assert np.hypot(*chief_ray(grating(0.9993)).p) == pytest.approx(0.9993, abs=1e-5)
    for sine in (0.9997, 1.005):
        with pytest.raises(
            PropagationError,
            match=r"leaves with n sin θ = (1\.000|1\.005), beyond the media",
        ):
            chief_ray(grating(sine))


def sparse(share):
    """A lens of which so many pillars were left standing at random."""
    lens = made("plain")
    d = np.where(
        np.random.default_rng(2).random(lens.diameters.diameter_um.shape) < share,
        lens.diameters.diameter_um,
        0,
    )
    return dataclasses.replace(lens, diameters=DiameterMap(d, PITCH))


def test_three_tenths_of_the_sites_are_enough():
    """Of π 4 λ f / site = 18771 about the ray."""
    assert chief_ray(sparse(0.33)).meets_um == pytest.approx(
        [0.0, 0.0], abs=0.3
    )  # the middle of what is left
    with pytest.raises(
        PropagationError,
        match=r"where the lens has 5[0-4]\d\d pillars; need 5631 about it",
    ):
        chief_ray(sparse(0.28))


def test_the_phase_is_looked_at_over_two_zones_or_sixty_pillars():
    """Radius 2 √(λ f), 2 · √(0.85 · 310) = 32.5 um; of a lens of 1 um of focal length
    √(120 site / π).
    """
    seen, about = [], chief._about

    def watched(lens, at, radius, tilt):
        seen.append((radius, tilt))
        return about(lens, at, radius, tilt)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chief, "_about", watched)
        chief_ray(made("off-centre"), (0.0, 0.05), 1900.0)
        chief_ray(dataclasses.replace(made("plain"), sensor_distance_um=1.0))
    assert seen[0][0] == pytest.approx(
        2 * math.sqrt(WAVE / (1 / 310 + 1 / 1900)), rel=1e-9
    )
    assert seen[1][0] == pytest.approx(math.sqrt(120 * PITCH**2 / math.pi), rel=1e-9)


def test_sources_lie_where_their_ray_through_the_middle_comes_from():
    """Tangents of collimated light; else backwards through 20 um of 1.62 and 90 of 1.45
    by Snell, and 1190 of air.
    """
    lens = made("all")
    assert chief.source_at(made("plain"), (0.2, -0.3), math.inf) == pytest.approx(
        np.tan([0.2, -0.3]), rel=1e-12
    )
    tangents = np.tan([0.2, -0.3])
    sine = np.hypot(*tangents) / math.hypot(1, np.hypot(*tangents))
    way = sum(
        t * sine / math.sqrt(n * n - sine**2)
        for n, t in ((1.62, 20.0), (1.45, 90.0), (1.0, 1190.0))
    )
    got = chief.source_at(lens, (0.2, -0.3), 1300.0)
    assert got == pytest.approx(-way * tangents / np.hypot(*tangents), rel=1e-9)
    assert chief.source_at(lens, (0.0, 0.0), 1300.0).tolist() == [0.0, 0.0]
