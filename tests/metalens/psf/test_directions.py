"""Far fields against closed forms (orders, sinc², Airy, Parseval), the plain sum, and
what a ring should hold.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special

from metalens import lens as lenses
from metalens.cell import Cell, Film, Index, Lattice
from metalens.core.errors import PropagationError
from metalens.lens import DiameterMap, Lens
from metalens.optics import Layers, Stop
from metalens.psf import far_field
from tests.command_line import call
from tests.proxies import proxy_of
from tests.referees import plain_sum

WAVE, PITCH = 0.633, 0.29
# every pillar alike, |t| 0.83
PROXY = proxy_of([1.3], [0.83], (0.1, 0.2), WAVE)
RNG = np.random.default_rng(3)


def lens(phase_rad, inside=None, *, pitch=PITCH, lattice=None, layers=None):
    """Turned pillars give any phase exactly: twice their turn."""
    there = np.ones(phase_rad.shape, bool) if inside is None else inside
    sizes = DiameterMap(
        np.where(there, 0.15, 0.0), pitch, lattice or Lattice(), angle_rad=phase_rad / 2
    )
    cell = Cell(pitch, lattice=lattice or Lattice())
    return Lens(
        sizes,
        cell,
        PROXY,
        WAVE,
        400.0,
        900.0,
        "map",
        hand="right",
        layers=layers or Layers(),
    )


def axes(rows, columns, step=PITCH):
    return (np.arange(columns) - (columns - 1) / 2) * step, (
        (np.arange(rows) - (rows - 1) / 2) * step
    )[:, None]


def test_a_linear_phase_sends_all_light_to_the_sine_of_wavelength_over_period():
    x, y = axes(140, 190)
    period, turn = 1.7, math.radians(37)
    phase = 2 * math.pi / period * (x * math.cos(turn) + y * math.sin(turn))
    found = far_field(lens(phase), samples=301)
    (beam,) = found.beams
    assert math.hypot(beam.sine_x, beam.sine_y) == pytest.approx(
        WAVE / period, abs=2e-5
    )  # a parabola at an eighth of a spot
    assert beam.azimuth_deg == pytest.approx(37.0, abs=0.01)
    assert beam.angle_deg == pytest.approx(
        math.degrees(math.asin(WAVE / period)), abs=0.01
    )
    assert found.transmitted == pytest.approx(0.83**2, rel=1e-6)
    assert (
        beam.share > 0.9
    )  # a square's spot: sinc² tails along both axes, 2 / (pi² 10 w) of each beyond the circle


def test_a_wave_that_comes_at_an_angle_leaves_a_flat_lens_at_it():
    found = far_field(
        lens(np.zeros((120, 90))), angle_rad=(math.radians(11), math.radians(-6))
    )
    tx, ty = math.tan(math.radians(11)), math.tan(math.radians(-6))
    norm = math.sqrt(1 + tx**2 + ty**2)
    assert (found.beams[0].sine_x, found.beams[0].sine_y) == pytest.approx(
        (tx / norm, ty / norm), abs=5e-5
    )


def test_a_stop_leaves_the_light_of_its_hole_where_it_falls_on_the_pillars():
    """20 um on a square of 87 um: the whole hole; at 40 degrees of so much glass half
    of it falls beside the square.
    """
    hole, whole = math.pi * 20.0**2, (300 * PITCH) ** 2
    inside = math.tan(math.asin(math.sin(math.radians(40)) / 1.5))
    for angle, thick, share in ((11, 30.0, 1.0), (40, 150 * PITCH / inside, 0.5)):
        layers = Layers(front=(Film(Index(1.5), thick),), stop=Stop(20.0, thick))
        tilted = {"angle_rad": (0.0, math.radians(angle)), "samples": 201}
        found = far_field(lens(np.zeros((300, 300)), layers=layers), **tilted)
        assert found.transmitted == pytest.approx(
            0.83**2 * share * hole / whole, rel=0.03
        )  # ripples finer than pillars
        assert found.beams[0].sine_y == pytest.approx(
            math.sin(math.radians(angle)), abs=1e-3
        )


def test_a_rectangle_shows_its_sinc():
    """sin² N u / (N sin u)² along each axis, u = pi pitch p / wavelength, in squares of
    0.0025.
    """
    rows, columns = 31, 47
    found = far_field(lens(np.zeros((rows, columns))), samples=801)
    square = found.sines[1] - found.sines[0]
    want = 1.0
    for n, p in ((columns, found.sines), (rows, found.sines[:, None])):
        u = math.pi * PITCH / WAVE * p
        want = want * n * PITCH / WAVE * special.diric(2 * u, n) ** 2
    density = found.share / square**2
    # middle of a square for its mean
    assert abs(density - want * (found.share > 0)).max() < 3e-3 * want.max()


def test_a_round_aperture_holds_airy_s_share_in_every_circle():
    x, y = axes(401, 401)
    radius = 55.0
    inside = np.hypot(x, y) <= radius
    found = far_field(lens(np.zeros(inside.shape), inside), samples=1501)
    square = found.sines[1] - found.sines[0]
    held = np.cumsum(found.rings)
    for ring in (5, 11, 23):
        v = 2 * math.pi / WAVE * radius * ring * square
        assert held[ring - 1] == pytest.approx(
            1 - special.j0(v) ** 2 - special.j1(v) ** 2, abs=8e-3
        )  # rim of sites
    # rim of sites
    assert found.beams[0].share == pytest.approx(found.beam_holds, abs=5e-3)
    v = 2 * math.pi / WAVE * radius * found.beam_sine
    # next term of the Bessel functions
    assert found.beam_holds == pytest.approx(1 - 2 / (math.pi * v), abs=1e-3)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_light_is_kept(kind):
    """Parseval over one period of the lattice; a coarse lattice tells no direction
    beyond its own diffraction.
    """
    phase = RNG.uniform(0, 6.28, (60, 84))
    inside = np.ones((60, 84), bool)
    if kind == "hexagonal":
        inside = (np.arange(60)[:, None] + np.arange(84)) % 2 == 0
    found = far_field(
        lens(phase, inside, pitch=0.41, lattice=Lattice(kind)), samples=201
    )
    assert found.share.sum() + found.beyond == pytest.approx(
        1.0, abs=2e-3 if kind == "hexagonal" else 1e-5
    )  # cut zone
    assert found.rings.sum() == pytest.approx(1 - found.beyond, abs=1e-5)
    assert found.steepest == pytest.approx(
        WAVE / (0.41 * (math.sqrt(3) if kind == "hexagonal" else 2)), rel=1e-6
    )


def test_every_direction_is_that_of_the_plain_sum():
    """A source of 700 um, random turns: |U|² = cos⁴ |F|² / (wavelength distance)² of the sum at 0.4 m."""
    made = lens(RNG.uniform(0, 6.28, (7, 11)))
    found = far_field(made, source_um=700.0, samples=1601)
    square, distance = found.sines[1] - found.sines[0], 4e5
    columns, rows = np.array([300, 777, 1400]), np.array([560, 1201])
    px, py = found.sines[columns], found.sines[rows][:, None]
    cosine = np.sqrt(1 - px**2 - py**2)
    density = found.share[np.ix_(rows, columns)] / square**2
    amplitude = made.transmission() * np.exp(1j * made.phase_rad())
    for i in range(2):
        for j in range(3):
            at = distance / cosine[i, j]
            where = SimpleNamespace(
                x_um=[at * px[j]],
                y_um=[at * py[i, 0]],
                distance_um=distance,
                wavelength_um=WAVE,
                depths_um=[700.0],
            )
            light = abs(plain_sum.field(made, amplitude, where)[0, 0, 0]) ** 2
            want = (
                light
                * distance**2
                / cosine[i, j] ** 4
                / (PITCH**2 * (np.abs(amplitude) ** 2).sum())
            )
            # mean over a square of 0.00125, spots of 0.2
            assert density[i, j] == pytest.approx(want, rel=5e-3)


def test_an_axicon_makes_a_ring_of_its_angle():
    x, y = axes(300, 300)
    sine, r = 0.31, np.hypot(x, y)
    found = far_field(lens(-2 * math.pi / WAVE * sine * r, r < 43.0), samples=401)
    square = found.sines[1] - found.sines[0]
    low, high = (int(edge / square) for edge in (sine - 0.03, sine + 0.03))
    assert found.rings[low:high].sum() > 0.9
    assert found.within_sine(0.5) == pytest.approx(sine, abs=0.01)
    assert found.beams == ()


def test_what_cannot_be_computed_is_refused():
    glass = Layers(front=(Film(Index(1.5), 300.0),))
    with pytest.raises(PropagationError, match="films in front"):
        far_field(lens(np.zeros((5, 6)), layers=glass), source_um=700.0)
    with pytest.raises(PropagationError, match="samples"):
        far_field(lens(np.zeros((5, 6))), samples=2)


def test_the_command_tells_beams_and_refuses_what_says_nothing(tmp_path, capsys):
    import json

    from metalens.core import store

    x, _ = axes(64, 96)
    lenses.save(
        tmp_path / "lens.h5",
        lens(np.broadcast_to(2 * math.pi / 2.1 * x, (64, 96)).copy()),
    )
    words = f"psf {tmp_path}/lens.h5 --far-field --report -o {tmp_path}/far.h5"
    assert call(f"{words} --angles-deg 0 5 --samples 101 --json") == 0
    told = json.loads(capsys.readouterr().out)
    sines = [field["beams"][0]["sine_x"] for field in told["fields"]]
    assert sines == pytest.approx(
        [WAVE / 2.1, WAVE / 2.1 + math.sin(math.radians(5))], abs=2e-4
    )
    kept = store.load(tmp_path / "far.h5", "far-field")
    assert kept.arrays["share"].shape == (2, 101, 101)
    assert (tmp_path / "far_far.png").exists()
    assert "azimuth" in (tmp_path / "far.html").read_text()
    assert call(f"{words} --force --depths-mm 3 4 1") == 2
    assert "depths_mm: not for a far field" in capsys.readouterr().err
