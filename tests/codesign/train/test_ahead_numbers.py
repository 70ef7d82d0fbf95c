"""How many steps are begun beside the one that is asked for, and how many threads are
left: at the very ends.
"""

import threading

import pytest
import torch

from codesign.train import ahead
from codesign.train.ahead import Prefetcher


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("count", "workers", "beside"),
    [(2, 1, 1), (2, 2, 1), (2, 5, 1), (5, 2, 3), (3, 0, 3)],
)
def test_the_work_takes_its_threads_from_the_step_and_leaves_one(
    threads, count, workers, beside
):
    threads(count)
    with Prefetcher(
        lambda step: threading.current_thread().name, end=9, workers=workers
    ) as going:
        assert going.take(3).startswith("ahead") == (workers > 0)
        with going.beside():
            assert torch.get_num_threads() == beside
        assert torch.get_num_threads() == count
    assert torch.get_num_threads() == count


@pytest.mark.parametrize(("end", "begun"), [(99, [6, 7]), (7, [6]), (6, []), (3, [])])
def test_as_many_steps_are_begun_as_there_are_workers_and_none_from_the_end_on(
    threads, end, begun
):
    """A step beyond the end that is asked for is done all the same."""
    threads(4)
    with Prefetcher(lambda step: 10 * step, end=end, workers=2) as going:
        assert going.take(5) == 50
        assert sorted(going._begun) == begun


@pytest.mark.parametrize(
    ("cores", "processes", "count"),
    [(1, "1", 1), (2, "1", 1), (4, "1", 2), (31, "2", 7), (40, "1", 8)],
)
def test_one_thread_at_least_and_eight_at_most_render_for_a_process(
    monkeypatch, cores, processes, count
):
    monkeypatch.setattr(ahead, "usable_cores", lambda: cores)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", processes)
    assert ahead.renderer_threads(torch.device("cuda")) == count


def test_a_process_alone_is_one(monkeypatch):
    monkeypatch.setattr(ahead, "usable_cores", lambda: 10)
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    assert ahead.renderer_threads(torch.device("cuda")) == 5
    assert ahead.renderer_threads(torch.device("cpu")) == 0
