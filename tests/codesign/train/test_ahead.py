"""Frames formed beside the step: in order, once, on a thread that torch's others make room for; the same numbers."""

import threading

import pytest
import torch

from codesign.train import run
from codesign.train.ahead import Ahead

STILL = """
preset = "smoke"
[scenes]
pixels = 32
margin = 5
pool = 6
[inner]
steps = 4
batch = 2
[inner.optics]
rate = 0.0
[inner.pitch]
rate = 0.0
[space]
resolution = [0.9, 1.0]
[run]
budgets_mmacs = [2.0]
pitch_um = 12.0
[optics]
image = "uniform"
aperture_mm = 0.3
focus_mm = 30.0
depths_mm = [16.0, 30.0]
sample_um = 12.0
depth_count = 4
window_samples = 11
"""


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


def test_a_still_lens_trains_to_the_same_bits_on_one_thread_and_two_and_after_a_stop(tmp_path, threads):
    path = tmp_path / "r.toml"
    path.write_text(STILL, "utf-8")
    settings, found = run.load(path), []
    for count, stop in ((1, 4), (2, 4), (2, 1)):
        threads(count)
        trainer = run.start(settings).trainer
        assert trainer._still
        lines = list(trainer.run(until=stop))
        if stop < 4:
            again = run.start(settings).trainer
            again.restore(trainer.state())
            lines, trainer = lines + list(again.run()), again
        found.append((lines, trainer.model.net.state_dict()))
    for lines, state in found[1:]:
        assert lines == found[0][0]
        assert all(torch.equal(state[name], value) for name, value in found[0][1].items())


@pytest.mark.parametrize("part", ["[inner.optics]\nrate = 0.0", "[inner.pitch]\nrate = 0.0", "pool = 6"])
def test_a_lens_or_a_pitch_that_moves_and_frames_that_are_rendered_wait_for_their_step(part, tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(STILL.replace(part, part.replace("0.0", "0.01").replace("pool = 6", "pool = 0")), "utf-8")
    assert not run.start(run.load(path)).trainer._still
