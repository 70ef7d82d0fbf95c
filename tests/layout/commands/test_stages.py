"""Long stages say where they are; short ones say nothing; compilation is told once."""

import threading

import numba
import numpy as np
import pytest

from layout.commands.stages import RowProgress, StageTimes
from layout.process import announce_compilation


def test_a_long_stage_speaks_and_a_short_one_does_not(plan):
    said, heard = [], threading.Event()
    lens = plan.lattices[0]
    share = f"{100 * 9 / lens.rows:.0f} % of the rows"

    def say(text):
        said.append(text)
        if share in text:
            heard.set()

    stages = StageTimes(say, first_s=0.02, next_s=0.02)
    watched = stages.rows.watched(plan)
    with stages("write"):
        assert np.array_equal(watched.lattices[0].source(0, 9), lens.source(0, 9))
        assert heard.wait(
            60
        )  # lines from before the rows were taken may come first, without a share
    assert all(line.startswith("write: ") for line in said)
    count = len(said)
    with StageTimes(said.append, first_s=60.0)("short"):
        pass
    assert len(said) == count
    assert set(stages.seconds) == {"write"}


def test_an_error_ends_the_stage():
    stages = StageTimes(lambda text: None)
    with pytest.raises(ZeroDivisionError), stages("broken"):
        _ = 1 / 0
    assert "broken" in stages.seconds
    assert threading.active_count() < 40


def test_the_time_left_is_of_the_pass_that_runs(plan):
    rows = RowProgress()
    source = rows.watched(plan).lattices[0].source
    assert rows.text == ""
    source(0, 11)
    first = rows.start
    source(11, 17)
    assert rows.start == first
    source(0, 11)
    assert rows.start > first
    source(11, plan.lattices[0].rows)
    assert rows.text == ""


def test_compilation_is_told_once_and_not_what_is_compiled_already():
    loop = numba.njit(lambda x: x + 3)
    said = []
    with announce_compilation(said.append):
        assert loop(2) == 5
        assert loop(2.5) == 5.5
    assert len(said) == 1
    assert "compiling" in said[0]
    with announce_compilation(said.append):
        assert loop(4) == 7
    assert len(said) == 1
