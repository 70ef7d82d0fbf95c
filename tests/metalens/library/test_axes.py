"""Libraries over two sizes: closed forms, exchanged axes, a finer solver, and a
function with poles that move.
"""

import cmath
import dataclasses
import math

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Circle, Ellipse, Rectangle
from metalens.core.errors import CellError, ConfigError, DomainError
from metalens.library import Sweep, axes

RANGE = (0.1, 0.27)
SQUARE = Cell(0.35, 0.4, Index(1.7), substrate=Index(1.45), shape=Rectangle())
# the same, and nothing is exchanged to save solves
CELL = dataclasses.replace(SQUARE, lattice=Lattice("rectangular", 1.0))
SETTINGS = Sweep(
    (0.7,), diameters_um=RANGE, lengths_um=RANGE, samples=35, tolerance=0.1
)


@pytest.fixture(scope="module")
def library():
    return axes.sweep_two_sizes(CELL, SETTINGS)


def moving(x, y):
    """Two components whose common pole moves with both sizes, half-width 0.04 of the
    span.
    """
    pole = 1 / (x - 0.35 - 0.3 * y + 0.04j)
    return np.stack(
        [np.exp(2j * x + 1j * y * x) + 0.03 * pole, np.cos(x - 2 * y) - 0.05j * pole],
        axis=-1,
    )


@pytest.mark.parametrize(("count", "most"), [(9, 0.3), (15, 3e-3), (21, 2e-4)])
def test_a_surface_with_a_moving_pole_converges_and_knows_its_error(count, most):
    nodes = (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2
    places = np.linspace(0, 1, 57)
    made = axes.interpolate_table(
        (nodes, nodes), moving(nodes[:, None], nodes), (places, places), tolerance=1e-4
    )
    error = abs(made.value - moving(places[:, None], places)).max(axis=-1)
    assert error.max() < most
    # where neither order sees the pole yet
    assert np.count_nonzero(error > made.doubt) < 0.02 * error.size


def test_a_surface_holds_its_nodes():
    nodes = (1 - np.cos(np.pi * np.arange(12) / 11)) / 2
    values = moving(nodes[:, None], nodes)
    x, y = nodes[[2, 5]], nodes[[3, 4]]
    made = axes.interpolate_table((nodes, nodes), values, (x, y), tolerance=1e-8)
    assert abs(made.value - values[np.ix_([2, 5], [3, 4])]).max() < 1e-8


def test_exchanged_sizes_exchange_x_and_y(library):
    assert not axes.is_exchange_symmetric(CELL, SETTINGS)
    assert axes.is_exchange_symmetric(SQUARE, SETTINGS)
    t = library.t[0]
    # solved one by one; normals of places that are as near to either edge of a corner
    # are a matter of rounding
    assert abs(t - t.swapaxes(0, 1)[..., ::-1, ::-1]).max() < 3e-4
    assert abs(t[3, 30, 0, 0] - t[3, 30, 1, 1]) > 0.05  # and they do differ
    assert np.abs(t[..., 0, 1]).max() < 1e-12  # mirrors


def test_bars_hold_against_a_finer_solver(library):
    rng = np.random.default_rng(5)
    assert library.usable.mean() > 0.9
    for i, j in rng.integers(0, 35, (4, 2)):
        x, y = float(library.x_um[i]), float(library.y_um[j])
        exact = rcwa.jones(
            axes.cell_of_sizes(SQUARE, x, y), x, 0.7, harmonics=library.harmonics + 4
        )
        assert abs(exact.t - library.t[0, i, j]).max() < library.t_error[0, i, j]


def test_pairs_held_out_lie_within_their_bars(library):
    assert library.missed == 0
    # the solver's part is not tried here
    assert np.median(library.held_out[:, 4] / library.held_out[:, 3]) > 2
    assert library.held_out.shape == (24, 5)
    _, x, y, error, _ = library.held_out[7]
    i, j = (
        int(np.argmin(abs(a - v))) for a, v in ((library.x_um, x), (library.y_um, y))
    )
    exact = rcwa.jones(
        axes.cell_of_sizes(SQUARE, x, y), x, 0.7, harmonics=library.harmonics
    ).t
    assert abs(exact - library.t[0, i, j]).max() == pytest.approx(error, abs=1e-9)


def film(permittivity, height=0.4, wavelength=0.7, below=1.45):
    """Slab between ``below`` and air: Airy's sum, power-normalised."""
    n = cmath.sqrt(permittivity)
    enter, leave = 2 * below / (below + n), 2 * n / (n + 1)
    down, up = (n - below) / (n + below), (n - 1) / (n + 1)
    phase = cmath.exp(2j * math.pi * n * height / wavelength)
    return enter * leave * phase / (1 - down * up * phase**2) / math.sqrt(below)


@pytest.mark.parametrize("shape", [Rectangle(), Ellipse()], ids=lambda s: s.kind)
def test_weak_pillars_are_a_film_of_the_mean_permittivity(shape):
    """Beyond it terms of second order in the contrast, depolarisation among them: a
    quarter at half the contrast.
    """
    x = 0.21
    y = 0.13
    share = {"rectangle": 1.0, "ellipse": math.pi / 4}[shape.kind]
    filled, off = share * x * y / 0.35**2, []
    for contrast in (0.2, 0.1):
        cell = dataclasses.replace(
            SQUARE, pillar=Index(math.sqrt(1 + contrast)), shape=shape
        )
        made = rcwa.jones(axes.cell_of_sizes(cell, x, y), x, 0.7, harmonics=4)
        xx, xy, yx, yy = made.t.ravel()
        off.append(
            np.abs(
                [xx - film(1 + filled * contrast), yy - film(1 + filled * contrast)]
            ).max()
        )
        assert max(abs(xy), abs(yx)) < 1e-12
        assert (np.angle(yy / xx) < 0) == (x > y)  # the longer axis is slower
    assert off[0] < 5e-3
    assert off[1] == pytest.approx(off[0] / 4, rel=0.15)


def test_a_library_is_read_as_it_was_written(library, tmp_path):
    axes.save_axes_library(tmp_path / "axes.h5", library)
    again = axes.load_axes_library(tmp_path / "axes.h5")
    assert (again.cell, again.sweep, again.solves) == (CELL, SETTINGS, library.solves)
    for name in ("t", "t_error", "x_um", "held_out"):
        assert np.array_equal(getattr(again, name), getattr(library, name))
    with pytest.raises(DomainError, match=r"holds 0\.7 um"):
        again.at(0.71)
    with pytest.raises(DomainError, match="need"):
        dataclasses.replace(library, t=library.t[:, 1:])


@pytest.mark.parametrize(
    ("cell", "change", "words"),
    [
        (dataclasses.replace(SQUARE, shape=Circle()), {}, "a circle has one size"),
        (dataclasses.replace(SQUARE, shape=Rectangle(0.6)), {}, "leave ratio out"),
        (SQUARE, {"lengths_um": (0.1, 0.36)}, "touches its neighbour"),
        (SQUARE, {"wavelengths_um": (0.35,)}, "orders .* in the cover"),
    ],
)
def test_cells_that_cannot_be_swept_over_two_sizes_are_refused(cell, change, words):
    with pytest.raises(CellError, match=words):
        axes.sweep_two_sizes(cell, dataclasses.replace(SETTINGS, **change))


@pytest.mark.parametrize(
    ("change", "words"),
    [({"diameters_um": None}, "diameters_um"), ({"angles_deg": (0.0, 5.0)}, "normal incidence"),
     ({"engine": "modal"}, "auto or rcwa"), ({"light": "circular"}, "linear"),
     ({"lengths_um": (0.2, 0.1)}, "least < largest"), ({"samples": 2000}, "1000 samples")],
)  # fmt: skip
def test_settings_that_do_not_go_together_are_refused(change, words):
    with pytest.raises(ConfigError, match=words):
        dataclasses.replace(SETTINGS, **change)
