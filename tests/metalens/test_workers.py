"""Worker processes: what comes back is what was computed, refusals keep their class, lost workers are told."""

import pytest

from metalens import rcwa, workers
from metalens.cell import Cell, Index
from metalens.engines import Light
from metalens.errors import CellError, MaterialError

CELL = Cell(0.30, 0.7, Index(3.6))
TASK = workers.points_task(CELL, Light(0.85), [0.1, 0.15], tolerance=5e-2, engine="rcwa")


def test_results_pass_through_text_without_loss():
    ((index, result),) = workers.run([TASK])
    assert index == 0
    exact = [rcwa.solve(CELL, d, 0.85, tolerance=5e-2) for d in (0.1, 0.15)]
    assert result["diameter_um"] == [0.1, 0.15]
    for (re, im), response in zip(result["t"], exact, strict=True):
        assert complex(re, im) == pytest.approx(response.t, abs=1e-12)  # another number of BLAS threads
    assert result["error"] == pytest.approx([response.t_error for response in exact], rel=1e-6)


def test_every_task_is_answered_once():
    tasks = [workers.points_task(CELL, Light(0.85), [0.05 + 0.02 * i], tolerance=0.1, engine="rcwa") for i in range(5)]
    found = dict(workers.run(tasks, processes=2))
    assert sorted(found) == [0, 1, 2, 3, 4]
    assert [found[i]["diameter_um"][0] for i in range(5)] == [0.05 + 0.02 * i for i in range(5)]


def test_refusals_keep_their_class():
    unknown = workers.points_task(Cell(0.3, 0.7, "a-Sj"), Light(0.85), [0.1], tolerance=0.1, engine="rcwa")
    with pytest.raises(MaterialError, match="did you mean 'a-Si'"):
        list(workers.run([TASK, unknown]))


def test_a_worker_that_dies_is_told():
    with pytest.raises(CellError, match="ended early"):
        list(workers.run([TASK | {"kind": "curve"}]))  # a curve without its span: an error of the program
