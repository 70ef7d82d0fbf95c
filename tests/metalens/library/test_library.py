"""Library sweeps: every entry against an exact solve, resumption to the same bytes,
refusals, store.
"""

import dataclasses
import math
import subprocess
import sys
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from metalens import library, modal, rcwa
from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Film, Index, Layer
from metalens.cell.shapes import Square
from metalens.core.errors import CellError, ConfigError, DomainError, MaterialError
from metalens.core.report import CommandConsole
from metalens.library import workers
from metalens.library.record import DEFAULT_CELL, PillarLibrary, Sweep

COARSE = Sweep(wavelengths_um=(0.84, 0.86), samples=40, tolerance=2e-2)


@pytest.fixture(scope="module")
def made() -> PillarLibrary:
    return library.sweep(DEFAULT_CELL, COARSE)


def test_entries_lie_within_their_error_bars(made):
    assert made.t.shape == (1, 1, 2, len(made.diameter_um))
    assert made.converged
    for k, wavelength in enumerate(made.wavelength_um):
        for i in range(0, len(made.diameter_um), 5):
            exact = modal.solve(
                DEFAULT_CELL,
                float(made.diameter_um[i]),
                float(wavelength),
                tolerance=5e-4,
            )
            assert (
                abs(made.t[0, 0, k, i] - exact.t)
                <= made.t_error[0, 0, k, i] + exact.t_error
            )


def test_one_bar_above_the_tolerance_is_enough_to_miss_it(made):
    bars = np.full(made.t_error.shape, 0.9 * COARSE.tolerance)
    assert dataclasses.replace(made, t_error=bars).converged
    bars[0, 0, 1, 3] = 1.1 * COARSE.tolerance
    assert not dataclasses.replace(made, t_error=bars).converged


def test_energy_is_conserved_within_the_error_bars(made):
    assert abs(made.energy - 1).max() < 2 * COARSE.tolerance


def test_axes_and_record(made):
    assert made.polarization == ("x",)
    assert made.angle_rad.tolist() == [0.0]
    assert made.diameter_um[0] == 0.06
    assert made.diameter_um[-1] == 0.25
    assert made.engine == "modal"
    assert made.solves < 100
    assert made.resonances.shape[1] == 5
    with pytest.raises(DomainError, match="has shape"):
        dataclasses.replace(made, t=made.t[..., :-1])
    with pytest.raises(DomainError, match="not finite"):
        dataclasses.replace(made, t_error=made.t_error * math.nan)


class Interrupted(CommandConsole):
    """A console whose user presses Ctrl-C after the first finished task."""

    def track(self, items: Iterable[Any], *, total: int, label: str) -> Iterator[Any]:
        """Pass one item."""
        for item in items:
            yield item
            raise KeyboardInterrupt


def test_an_interrupted_sweep_goes_on_to_the_same_bytes(made, tmp_path):
    journal = tmp_path / "library.h5.resume"
    with pytest.raises(KeyboardInterrupt):
        library.sweep(
            DEFAULT_CELL, COARSE, console=Interrupted(quiet=True), checkpoint=journal
        )
    kept = journal.read_text().split("\n")
    assert len(kept) >= 2
    # as after a kill in the middle of a line
    journal.write_text("\n".join([*kept[:2], '["cut sho']))
    again = library.sweep(DEFAULT_CELL, COARSE, checkpoint=journal)
    assert not journal.exists()
    library.save(tmp_path / "a.h5", made)
    library.save(tmp_path / "b.h5", again)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_a_journal_of_another_sweep_is_not_used(tmp_path):
    journal = tmp_path / "library.h5.resume"
    journal.write_text('["0.0.9", "another"]\n["task", {}]\n')
    small = Sweep(samples=20, tolerance=5e-2, diameters_um=(0.08, 0.12))
    assert library.sweep(DEFAULT_CELL, small, checkpoint=journal).t.shape[-1] == 20


def test_oblique_polarisations_agree_at_normal_incidence():
    sweep = Sweep(
        angles_deg=(0.0, 8.0), samples=20, tolerance=5e-2, diameters_um=(0.08, 0.16)
    )
    made = library.sweep(DEFAULT_CELL, sweep)
    assert made.polarization == ("s", "p")
    assert np.array_equal(made.t[0, 0], made.t[1, 0])
    d, angle = float(made.diameter_um[10]), math.radians(8)
    for i, name in enumerate(("s", "p")):
        exact = rcwa.solve(
            DEFAULT_CELL, d, 0.85, angle_rad=angle, polarization=name, harmonics=8
        )
        assert (
            abs(made.t[i, 1, 0, 10] - exact.t)
            <= made.t_error[i, 1, 0, 10] + exact.t_error
        )
    assert abs(made.t[0, 1, 0, 10] - made.t[1, 1, 0, 10]) > 0


def test_loading_a_library_needs_neither_torch_nor_matplotlib():
    code = "import sys, metalens.library; print({'torch', 'matplotlib', 'numba'} & set(sys.modules))"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True
        ).stdout
        == "set()\n"
    )


def test_films_go_to_the_modal_solver_and_other_shapes_to_rcwa():
    coated = dataclasses.replace(DEFAULT_CELL, over=(Film(Index(1.45), 0.1),))
    assert workers.choose_engine(coated) == "modal"
    assert (
        workers.solve_to_tolerance(
            coated, Incidence(0.85), tolerance=5e-2, engine="modal"
        )(0.1).engine
        == "modal"
    )
    square = dataclasses.replace(DEFAULT_CELL, shape=Square())
    small = Sweep(samples=20, tolerance=5e-2, diameters_um=(0.08, 0.12), engine="modal")
    assert workers.choose_engine(square) == "rcwa"
    with pytest.raises(
        CellError, match="round pillars on a square lattice, not square on a square"
    ):
        library.sweep(square, small)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"wavelengths_um": ()}, "wavelengths_um"),
        ({"wavelengths_um": (0.86, 0.84)}, "rising"),
        ({"wavelengths_um": (math.inf,)}, "finite"),
        ({"angles_deg": (0.0, 90.0)}, "angles_deg"),
        ({"angles_deg": (-1.0,)}, "angles_deg"),
        ({"samples": 3}, "samples"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"engine": "fdtd"}, "engine"),
    ],
)
def test_bad_sweeps_are_refused(change, words):
    with pytest.raises(ConfigError, match=words):
        Sweep(**change)


def test_propagating_orders_are_named():
    n = 1.4525
    for pitch, angle in ((0.85 / n * 1.001, 0.0), (0.7, 0.0), (0.45, 30.0)):
        cell = Cell(pitch, 0.7, Index(3.6), cover=Index(n))
        with pytest.raises(CellError, match=r"orders .*\(-1, 0\).* in the cover"):
            library.check_sweep(cell, Sweep(angles_deg=(angle,)))
    library.check_sweep(
        Cell(0.85 / n * 0.999, 0.7, Index(3.6), cover=Index(n)), Sweep()
    )


def test_orders_at_grazing_are_refused_too():
    cell = Cell(0.85, 0.7, Index(3.6), substrate=Index(1.0))
    with pytest.raises(CellError, match="propagate"):
        library.check_sweep(cell, Sweep())


def test_impossible_diameters_and_wavelengths_are_refused():
    with pytest.raises(CellError, match="pillars touch"):
        library.check_sweep(DEFAULT_CELL, Sweep(diameters_um=(0.1, 0.3)))
    for span in ((0.2, 0.1), (0.0, 0.1), (-0.1, 0.1), (math.nan, 0.2)):
        with pytest.raises(CellError, match="0 < least < largest"):
            library.check_sweep(DEFAULT_CELL, Sweep(diameters_um=span))
    with pytest.raises(MaterialError):
        library.check_sweep(Cell(0.2, 0.7, "a-Si"), Sweep(wavelengths_um=(30.0,)))


@pytest.mark.parametrize(
    "part", [{"material": "Si"}, {"between": "Si"}, {"coat": "Si", "coat_um": 0.01}]
)
def test_materials_of_layers_are_asked_for_before_anything_is_solved(part):
    """The shipped table of silicon ends below 30 um; plain numbers elsewhere hold at
    any wavelength.
    """
    air = Index(1.0)
    cell = Cell(
        5.0,
        4.0,
        Index(3.0),
        air,
        air,
        air,
        shape=Square(),
        layers=(Layer(3.0), Layer(1.0, **part)),
    )
    with pytest.raises(MaterialError, match="Si at 30"):
        library.check_sweep(
            cell, Sweep(wavelengths_um=(30.0,), diameters_um=(1.0, 3.0))
        )


def test_workers_pass_refusals_on():
    absorbing = dataclasses.replace(DEFAULT_CELL, substrate=Index(1.45, 0.1))
    with pytest.raises(CellError, match="absorbs"):
        library.sweep(absorbing, Sweep(samples=20, tolerance=5e-2))
