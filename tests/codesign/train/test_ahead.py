"""Frames formed beside the step: in order, once, on a thread that torch's others make room for; the same numbers."""

import threading

import pytest
import torch

from codesign.train.ahead import Ahead


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

    with Ahead(work, end=7) as ahead:
        assert ahead.take(5) == 25
        assert began.wait(10)  # nobody asked for 6 yet
        with ahead.beside():
            assert torch.get_num_threads() == 2
        assert torch.get_num_threads() == 3
        assert ahead.take(6) == 36
        ahead._pool.submit(int).result()  # of one worker: what was begun before is done
    assert [step for step, _, _ in done] == [5, 6]
    assert all(name.startswith("ahead") and count == 1 for _, name, count in done)
    assert torch.get_num_threads() == 3


def test_one_thread_of_torch_stays_one_thread(threads):
    threads(1)
    with Ahead(lambda step: threading.current_thread(), end=9) as ahead:
        assert ahead.take(2) is threading.main_thread()


def test_what_goes_wrong_beside_the_step_is_raised_in_it(threads):
    threads(2)
    with Ahead(lambda step: 1 // (step - 4), end=9) as ahead:
        assert ahead.take(3) == -1
        with pytest.raises(ZeroDivisionError):
            ahead.take(4)
        assert ahead.take(5) == 1
