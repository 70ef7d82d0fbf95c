"""Three processes played by three threads that sum in step: parts, means and statistics
of unlike numbers.
"""

import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from codesign.batches import parallel
from codesign.batches.batch import EyePose, FrameBatch
from metalens.core.errors import TrainingError
from metalens.image import Frames

COUNT = 3


class Group:
    """A group of processes whose members are threads."""

    def __init__(self, count=COUNT):
        self.mine, self.gate, self.given = (
            threading.local(),
            threading.Barrier(count),
            [None] * count,
        )

    def is_initialized(self):
        return True

    def get_rank(self):
        return self.mine.rank

    def get_world_size(self):
        return len(self.given)

    def all_reduce(self, value):
        self.given[self.mine.rank] = value.clone()
        self.gate.wait(4)
        total = sum(self.given)
        self.gate.wait(4)
        value.copy_(total)


@pytest.fixture
def together(monkeypatch):
    """Runs ``work(rank)`` as each of three members at once: what each of them found."""

    def run(work, count=COUNT):
        group = Group(count)
        monkeypatch.setattr(parallel, "dist", group)

        def member(rank):
            group.mine.rank = rank
            return work(rank)

        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(member, range(count)))

    return run


def batch(size):
    """Frames whose every number tells its row."""
    rows = torch.arange(float(size))
    frames = Frames(
        *(
            rows[:, None, None, None] + k * torch.ones(size, 2, 4, 5)
            for k in (0.1, 0.2, 0.3)
        )
    )
    pose = EyePose(
        rows[:, None] + torch.ones(3),
        rows[:, None] + torch.ones(3) / 2,
        rows[:, None, None] + torch.ones(2, 2),
    )
    return FrameBatch(
        frames,
        rows[:, None, None] * torch.ones(size, 4, 5),
        rows[:, None] * torch.ones(3) * 0.7,
        pose,
    )


@pytest.mark.parametrize("posed", [True, False])
def test_a_batch_falls_into_parts_in_the_order_of_ranks(together, posed):
    whole = batch(12)
    whole = whole if posed else FrameBatch(whole.frames, whole.mask, whole.slip_mm)
    for rank, part in enumerate(together(lambda rank: parallel.part_of(whole))):
        rows = [4 * rank, 4 * rank + 1, 4 * rank + 2, 4 * rank + 3]
        assert torch.equal(part.mask, whole.mask[rows])
        assert torch.equal(part.slip_mm, whole.slip_mm[rows])
        assert torch.equal(part.frames.depth_um, whole.frames.depth_um[rows])
        assert torch.equal(part.frames.radiance, whole.frames.radiance[rows])
        assert (part.pose is not None) == posed
        if posed:
            assert torch.equal(part.pose.points, whole.pose.points[rows])
    with pytest.raises(TrainingError, match="13 frames on 3 processes"):
        together(lambda rank: parallel.part_of(batch(13)))


def test_gradients_and_numbers_are_means_over_the_three(together):
    """Gradients of 1, 10 and 100 times a pattern have 37 times it for a mean; a
    parameter without one stays without.
    """
    shapes = [
        ((2, 3), torch.float32),
        ((4,), torch.float64),
        ((3, 1, 2), torch.float32),
    ]
    patterns = [
        torch.arange(1.0, 1 + torch.Size(s).numel(), dtype=kind).view(s)
        for s, kind in shapes
    ]

    def work(rank):
        parameters = [
            torch.nn.Parameter(torch.zeros_like(p)) for p in (*patterns, patterns[0])
        ]
        for parameter, pattern in zip(parameters, patterns, strict=False):
            parameter.grad = pattern * 10**rank
        parallel.average_gradients(parameters)
        return [p.grad for p in parameters], parallel.mean_of([0.3 + rank, -7.0 * rank])

    for grads, means in together(work):
        assert grads[3] is None
        for got, pattern in zip(grads, patterns, strict=False):
            torch.testing.assert_close(got, 37 * pattern)
        assert means == pytest.approx([1.3, -7.0], rel=1e-12)


def test_gradients_of_one_kind_are_means_as_well(together):
    """4, 7 and 10 times a pattern; values of one dtype alone."""

    def work(rank):
        parameters = [torch.nn.Parameter(torch.zeros(n)) for n in (2, 5)]
        for parameter in parameters:
            parameter.grad = (4.0 + 3 * rank) * torch.arange(1.0, 1 + len(parameter))
        parallel.average_gradients(parameters)
        return [p.grad.tolist() for p in parameters]

    assert together(work) == [[[7.0, 14.0], [7.0, 14.0, 21.0, 28.0, 35.0]]] * COUNT


def test_work_is_dealt_out_in_turn_and_told_to_all(together):
    done = [[] for _ in range(COUNT)]

    def work(rank):
        return parallel.share_work(
            lambda item: done[rank].append(item) or 2.5 * item, [3, 4, 5, 6, 7, 8, 9]
        )

    assert together(work) == [[7.5, 10.0, 12.5, 15.0, 17.5, 20.0, 22.5]] * COUNT
    assert done == [[3, 6, 9], [4, 7], [5, 8]]
    assert (
        together(
            lambda rank: parallel.share_work(lambda item: item + 0.5, [1, 2, 4]), 2
        )
        == [[1.5, 2.5, 4.5]] * 2
    )


def test_statistics_of_a_layer_and_their_gradients_are_those_of_all_frames(together):
    """Against torch on the joined frames; an epsilon that is no rounding of the
    variances beside.
    """
    draw = torch.Generator().manual_seed(4)
    x = 3 + 2 * torch.randn(6, 4, 3, 5, generator=draw, dtype=torch.float64)
    weight, bias, pull = (
        torch.randn(s, generator=draw, dtype=torch.float64) for s in (4, 4, x.shape)
    )
    for about in ({}, {"epsilon": 0.3}):
        whole, w = x.clone().requires_grad_(), weight.clone().requires_grad_()
        want = torch.nn.functional.batch_norm(
            whole, None, None, w, bias, training=True, eps=about.get("epsilon", 1e-5)
        )
        slope, steepness = torch.autograd.grad((want * pull).sum(), (whole, w))

        def work(rank, about=about):
            rows = slice(2 * rank, 2 * rank + 2)
            mine, w = x[rows].clone().requires_grad_(), weight.clone().requires_grad_()
            got = parallel.batch_norm(mine, w, bias, **about)
            return got.detach(), *torch.autograd.grad(
                (got * pull[rows]).sum(), (mine, w)
            )

        parts = together(work)
        torch.testing.assert_close(
            torch.cat([p[0] for p in parts]), want.detach(), rtol=1e-9, atol=1e-9
        )
        torch.testing.assert_close(
            torch.cat([p[1] for p in parts]), slope, rtol=1e-9, atol=1e-9
        )
        torch.testing.assert_close(
            sum(p[2] for p in parts), steepness, rtol=1e-9, atol=1e-9
        )


def test_one_process_alone_asks_nobody(monkeypatch):
    monkeypatch.setattr(parallel, "dist", SimpleNamespace(is_initialized=lambda: False))
    assert (parallel.process_rank(), parallel.process_count()) == (0, 1)
    whole = batch(5)
    assert parallel.part_of(whole) is whole
    assert parallel.mean_of([0.3, 0.9]) == [0.3, 0.9]
    assert parallel.share_work(lambda item: item + 0.5, [3, 1]) == [3.5, 1.5]
    parameter = torch.nn.Parameter(torch.ones(3))
    parameter.grad = torch.tensor([0.2, 0.4, 0.7])
    parallel.average_gradients([parameter])
    assert parameter.grad.tolist() == pytest.approx([0.2, 0.4, 0.7])


@pytest.mark.parametrize(
    ("world", "begun", "joins"),
    [("2", False, True), ("1", False, False), ("3", True, False), (None, False, False)],
)
def test_only_several_processes_join_and_once(monkeypatch, world, begun, joins):
    asked = []
    monkeypatch.setattr(
        parallel,
        "dist",
        SimpleNamespace(
            is_initialized=lambda: begun,
            init_process_group=lambda kind: asked.append(kind),
        ),
    )
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    if world:
        monkeypatch.setenv("WORLD_SIZE", world)
    parallel.join_processes(torch.device("cpu"))
    assert asked == (["gloo"] if joins else [])


@pytest.mark.parametrize("count", [1, 2])
def test_waiting_is_for_others(monkeypatch, count):
    waited = []
    about = {
        "is_initialized": lambda: True,
        "get_world_size": lambda: count,
        "barrier": lambda: waited.append("wait"),
    }
    monkeypatch.setattr(
        parallel,
        "dist",
        SimpleNamespace(**about, destroy_process_group=lambda: waited.append("part")),
    )
    parallel.wait_for_all()
    assert waited == ["wait"] * (count - 1)
    parallel.leave_processes()
    assert waited[count - 1 :] == ["wait", "part"]
