"""Frames through patches taken together, by convolutions that are counted out source by
source.
"""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.field import together

draw = np.random.default_rng(31)
FRAMES, SHEETS, HIGH, WIDE, WINDOW, DEPTHS = 2, 3, 9, 11, 3, 5


def patch(rows, columns, kernels, coverage):
    pixels = (rows[1] - rows[0]) * (columns[1] - columns[0])
    weights = torch.from_numpy(draw.normal(size=(pixels, DEPTHS, kernels))).float()
    energy = torch.from_numpy(draw.uniform(0.4, 1.3, (pixels, DEPTHS))).float()
    return SimpleNamespace(
        rows=rows, columns=columns, weights=weights, energy=energy, coverage=coverage
    )


PATCHES = [
    patch((0, 4), (0, 6), 2, 1), patch((4, 9), (0, 6), 3, 2), patch((0, 4), (5, 11), 4, 3), patch((3, 7), (2, 8), 1, 1),
]  # fmt: skip
KERNELS = [draw.normal(size=(p.weights.shape[-1], WINDOW, WINDOW)) for p in PATCHES]
SIZES = [
    (p.rows[1] - p.rows[0] + WINDOW - 1, p.columns[1] - p.columns[0] + WINDOW + 1)
    for p in PATCHES
]
TRANSFER = [
    torch.from_numpy(np.fft.rfft2(kernel, s=size)).to(torch.complex64)
    for kernel, size in zip(KERNELS, SIZES, strict=True)
]
GIVEN = tuple(draw.uniform(0.1, 1.9, (FRAMES, SHEETS, HIGH, WIDE)) for _ in range(2))
PLACE = draw.uniform(0, DEPTHS - 1, (FRAMES, SHEETS, HIGH, WIDE))
PLACE[0, 0, 0, 0], PLACE[1, 2, 8, 10] = 0.0, DEPTHS - 1.0


def cubic(at):
    """First node and weights of the cubic through four nodes about a place, the
    outermost ones at the ends.
    """
    first = min(max(int(np.floor(at)) - 1, 0), DEPTHS - 4)
    nodes = np.arange(first, first + 4)
    return nodes, np.array(
        [np.prod([(at - o) / (n - o) for o in nodes if o != n]) for n in nodes]
    )


@functools.cache
def counted(kinds):
    """Σ over patches, their pixels and kernels; light takes E, coverage its first
    kernels alone.
    """
    out = np.zeros((FRAMES, kinds, SHEETS, HIGH + WINDOW - 1, WIDE + WINDOW - 1))
    for p, kernels in zip(PATCHES, KERNELS, strict=True):
        wide = p.columns[1] - p.columns[0]
        for f, s in np.ndindex(FRAMES, SHEETS):
            for y in range(*p.rows):
                for x in range(*p.columns):
                    pixel = (y - p.rows[0]) * wide + x - p.columns[0]
                    nodes, taps = cubic(PLACE[f, s, y, x])
                    weights = taps @ p.weights[pixel].double().numpy()[nodes]
                    level = taps @ p.energy[pixel].double().numpy()[nodes]
                    seen = np.s_[f, 0, s, y : y + WINDOW, x : x + WINDOW]
                    out[seen] += (
                        GIVEN[0][f, s, y, x]
                        * level
                        * np.einsum("k,kij->ij", weights, kernels)
                    )
                    if kinds == 2:
                        few = np.einsum(
                            "k,kij->ij", weights[: p.coverage], kernels[: p.coverage]
                        )
                        out[f, 1, s, y : y + WINDOW, x : x + WINDOW] += (
                            GIVEN[1][f, s, y, x] * few
                        )
    return out


@pytest.mark.parametrize("held", [together.BYTES, 1, 3 * 8 * 6 * 4 * 6 * 5])
@pytest.mark.parametrize("kinds", [1, 2])
def test_light_and_coverage_are_added_up_over_patches_kernels_and_sources(kinds, held):
    """Patches that overlap, of unlike sizes and numbers of kernels, all at once, one by
    one and a few; what was there
    stays. Single precision of sums of a few hundred numbers of 3."""
    given = tuple(torch.from_numpy(part).float() for part in (*GIVEN, PLACE))
    out = torch.full(
        (FRAMES, kinds, SHEETS, HIGH + WINDOW - 1, WIDE + WINDOW - 1), 0.25
    )
    together.through(given, PATCHES, TRANSFER, SIZES, out, held)
    assert out.numpy() - 0.25 == pytest.approx(counted(kinds), abs=2e-4)


def sized(rows, columns, kernels, points):
    one = SimpleNamespace(
        rows=(3 + kernels, 3 + kernels + rows),
        columns=(2 * kernels, 2 * kernels + columns),
    )
    return one, torch.zeros(kernels, points // kernels)


def test_patches_of_one_size_go_together_by_their_kernels_as_many_as_there_is_room_for():
    """The largest of a size decides how many; at least one; those of few kernels first."""
    many = [
        sized(4, 6, 3, 30),
        sized(6, 4, 2, 20),
        sized(4, 6, 1, 10),
        sized(4, 6, 2, 20),
        sized(4, 6, 3, 30),
    ]
    patches, transfer = map(list, zip(*many, strict=True))
    assert list(together._alike(patches, transfer, 89)) == [[2, 3], [0, 4], [1]]
    assert list(together._alike(patches, transfer, 90)) == [[2, 3, 0], [4], [1]]
    assert list(together._alike(patches, transfer, 29)) == [[2], [3], [0], [4], [1]]
    assert list(together._alike(patches, transfer, 10**6)) == [[2, 3, 0, 4], [1]]


def test_kernels_that_some_patches_lack_are_zeros_behind_theirs():
    found = together._stacked(
        [
            torch.tensor([[2.0, 3.0]]),
            torch.tensor([[5.0, 7.0], [11.0, 13.0], [17.0, 19.0]]),
        ]
    )
    assert found.tolist() == [[[2, 3], [0, 0], [0, 0]], [[5, 7], [11, 13], [17, 19]]]


def test_two_gigabytes_of_spectra_are_held_where_nothing_is_said():
    assert together.BYTES == 2 * 1024**3


def test_slopes_of_transfers_are_those_of_the_sum():
    """Linear in every kernel: the change along a direction is the sum with that in
    place of the kernels.
    """
    given = tuple(torch.from_numpy(part).float() for part in (*GIVEN, PLACE))
    transfer = [part.clone().requires_grad_() for part in TRANSFER]
    out = torch.zeros(FRAMES, 1, SHEETS, HIGH + WINDOW - 1, WIDE + WINDOW - 1)
    together.through(given, PATCHES, transfer, SIZES, out)
    weight = torch.from_numpy(draw.normal(size=out.shape)).float()
    slopes = torch.autograd.grad((out * weight).sum(), transfer)
    change = sum(
        float((slope.conj() * part).real.sum())
        for slope, part in zip(slopes, TRANSFER, strict=True)
    )
    assert change == pytest.approx(float((out.detach() * weight).sum()), rel=1e-4)
