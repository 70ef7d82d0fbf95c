"""Monte Carlo of the process on workers: the bytes of this process, from any number of them and with one lost."""

import dataclasses

import pytest

from layout.process.process import Process
from layout.study import sensitivity, tolerance
from metalens.cell.record import Index
from metalens.ground import executor
from tests.layout.study.test_tolerance import SENS, hyperbolic
from tests.lost_worker import losing_one


def content(lens):
    """All numbers of a study with 40 draws, two batches, as bytes."""
    found = tolerance.analyse(lens, Process(), sens=SENS, draws=40, seed=3)
    rows = [getattr(found.draws, field.name).tobytes() for field in dataclasses.fields(found.draws)]
    return [*rows, repr((found.effects, found.rank, found.error))]


@pytest.fixture(scope="module")
def plain():
    lens = hyperbolic(51)
    return lens, content(lens)


def test_draws_are_the_same_from_more_workers_than_batches(plain):
    lens, here = plain
    with executor.on(processes=3):  # two batches
        assert content(lens) == here


def test_draws_are_the_same_from_a_cluster_that_loses_a_worker(plain, tmp_path):
    lens, here = plain
    with losing_one(tmp_path) as address, executor.on(address):
        assert content(lens) == here


def unlike(cell, diameter_um, wavelength_um, finer):
    """A solver by formula: every number of the cell counts, and the truncation."""
    change = 3.7j * cell.height_um + 0.4 * cell.sidewall_rad - 0.2j * complex(cell.pillar.n)
    return (1 + 0.01 * finer) * (change * diameter_um / wavelength_um + 2.1)


def test_answers_of_a_solver_are_gathered_in_the_order_of_their_causes():
    lens = dataclasses.replace(hyperbolic(), cell=dataclasses.replace(hyperbolic().cell, pillar=Index(3.6)))
    here = sensitivity.sensitivities(lens, count=5, solver=unlike)
    with executor.on(processes=2):
        there = sensitivity.sensitivities(lens, count=5, solver=unlike)
    assert there.rates.tobytes() == here.rates.tobytes()
