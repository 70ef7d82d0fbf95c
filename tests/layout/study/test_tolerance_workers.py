"""Monte Carlo of the process on workers: the bytes of this process, from any number of
them and with one lost.
"""

import dataclasses

import pytest

from layout.process.process import Process
from layout.study import sensitivity, tolerance
from metalens.cell.record import Index
from metalens.core import executor
from tests.layout.study.test_tolerance import SENS, hyperbolic


def content(lens):
    """All numbers of a study with 26 draws, two batches, as bytes."""
    found = tolerance.analyse_tolerance(lens, Process(), sens=SENS, draws=26, seed=3)
    rows = [
        getattr(found.draws, field.name).tobytes()
        for field in dataclasses.fields(found.draws)
    ]
    return [*rows, repr((found.effects, found.rank, found.error))]


@pytest.fixture(scope="module")
def plain():
    lens = hyperbolic(31)
    return lens, content(lens)


def unlike(cell, diameter_um, wavelength_um, finer):
    """A solver by formula: every number of the cell counts, and the truncation."""
    change = (
        3.7j * cell.height_um + 0.4 * cell.sidewall_rad - 0.2j * complex(cell.pillar.n)
    )
    return (1 + 0.01 * finer) * (change * diameter_um / wavelength_um + 2.1)


def test_more_workers_than_batches_give_the_same_draws_and_answers_in_the_order_of_their_causes(
    plain,
):
    lens, here = plain
    solved = dataclasses.replace(
        lens, cell=dataclasses.replace(lens.cell, pillar=Index(3.6))
    )
    answers = sensitivity.compute_sensitivities(solved, count=5, solver=unlike)
    with executor.run_on(processes=3):  # two batches
        assert content(lens) == here
        assert (
            sensitivity.compute_sensitivities(
                solved, count=5, solver=unlike
            ).rates.tobytes()
            == answers.rates.tobytes()
        )
