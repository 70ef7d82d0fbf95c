"""Frames formed beside the step: in order, once, on a thread that torch's others make
room for; the same numbers.
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


def test_the_next_step_is_begun_and_none_beyond_the_end(threads):
    threads(3)
    done, began = [], threading.Event()

    def work(step):
        done.append((step, threading.current_thread().name, torch.get_num_threads()))
        if step == 6:
            began.set()
        return step**2

    with Prefetcher(work, end=7) as going:
        assert going.take(5) == 25
        assert began.wait(10)  # nobody asked for 6 yet
        with going.beside():
            assert torch.get_num_threads() == 2
        assert torch.get_num_threads() == 3
        assert going.take(6) == 36
        going._pool.submit(int).result()  # of one worker: what was begun before is done
    assert [step for step, _, _ in done] == [5, 6]
    assert all(name.startswith("ahead") and count == 1 for _, name, count in done)
    assert torch.get_num_threads() == 3


def test_one_thread_of_torch_stays_one_thread(threads):
    threads(1)
    with Prefetcher(lambda step: threading.current_thread(), end=9) as going:
        assert going.take(2) is threading.main_thread()


def test_without_workers_a_step_has_all_threads_and_does_its_own_work(threads):
    threads(2)
    with Prefetcher(
        lambda step: (step, threading.current_thread(), torch.get_num_threads()),
        end=9,
        workers=0,
    ) as going:
        assert going.take(4) == (4, threading.main_thread(), 2)
        with going.beside():
            assert torch.get_num_threads() == 2


def test_what_goes_wrong_beside_the_step_is_raised_in_it(threads):
    threads(2)
    with Prefetcher(lambda step: 1 // (step - 4), end=9) as going:
        assert going.take(3) == -1
        with pytest.raises(ZeroDivisionError):
            going.take(4)
        assert going.take(5) == 1


def test_several_begin_at_once_each_step_once_and_in_its_place(threads):
    """Two workers: both steps beyond the one asked for wait for each other, so they
    must run at the same time.
    """
    threads(4)
    done, both = [], threading.Barrier(2)

    def work(step):
        done.append(step)
        if step in (4, 5):
            both.wait(10)
        return step**2

    with Prefetcher(work, end=6, workers=2) as going:
        assert [going.take(step) for step in range(3, 6)] == [9, 16, 25]
        with going.beside():
            assert torch.get_num_threads() == 2
    assert sorted(done) == [3, 4, 5]


def test_renderers_beside_a_gpu_are_half_of_the_cores_shared_by_its_processes(
    monkeypatch,
):
    monkeypatch.setattr(ahead, "usable_cores", lambda: 12)
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    assert ahead.renderer_threads(torch.device("cpu")) == 0
    assert ahead.renderer_threads(torch.device("cuda")) == 6
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert ahead.renderer_threads(torch.device("cuda")) == 1
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    monkeypatch.setattr(ahead, "usable_cores", lambda: 44)
    assert ahead.renderer_threads(torch.device("cuda")) == 8  # not 11
