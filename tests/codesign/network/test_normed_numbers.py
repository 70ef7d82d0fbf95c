"""Normalisation with its activation: values by hand, slopes by PyTorch in double
precision and by differences.
"""

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from codesign.network import normed


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    """Small batches too."""
    monkeypatch.setattr(normed, "_LEAST", 1)


def plain(x, weight, bias, kind):
    """PyTorch's own steps."""
    y = F.batch_norm(x, None, None, weight, bias, training=True)
    return {None: y, "relu": F.relu(y), "hardswish": F.hardswish(y)}[kind]


def drawn(shape, *, mean=0.0, spread=1.0, seed=3):
    """Frames, weights, biases and the slopes of what comes after."""
    draw = torch.Generator().manual_seed(seed)
    x = mean + spread * torch.randn(shape, generator=draw)
    weight, bias = (torch.randn(shape[1], generator=draw) for _ in range(2))
    return (
        x.contiguous(memory_format=torch.channels_last),
        weight,
        bias,
        torch.randn(shape, generator=draw),
    )


def slopes(work, x, weight, bias, after, kind):
    """Values, and derivatives with respect to frames, weights and biases."""
    given = [part.clone().requires_grad_() for part in (x, weight, bias)]
    y = work(*given, kind)
    return [y.detach(), *torch.autograd.grad(y, given, after)]


def test_two_channels_by_hand():
    """1, 2, 3, 6 have mean 3 and variance 3.5; the other channel -1, -1, 1, 1 variance
    1.
    """
    x = torch.tensor([[1.0, -1.0], [2.0, -1.0], [3.0, 1.0], [6.0, 1.0]])[
        :, :, None, None
    ]
    weight, bias = torch.tensor([2.0, -3.0]), torch.tensor([0.5, 1.0])
    one = 2 * (np.array([1.0, 2.0, 3.0, 6.0]) - 3) / np.sqrt(3.5 + 1e-5) + 0.5
    two = -3 * np.array([-1.0, -1.0, 1.0, 1.0]) / np.sqrt(1 + 1e-5) + 1
    want = np.stack([one, two], 1)
    assert normed.batch_norm(x, weight, bias, None).numpy()[
        :, :, 0, 0
    ] == pytest.approx(want, rel=1e-6)
    relu = normed.batch_norm(x, weight, bias, "relu").numpy()[:, :, 0, 0]
    assert relu == pytest.approx(np.maximum(want, 0), rel=1e-6)
    swish = normed.batch_norm(x, weight, bias, "hardswish").numpy()[:, :, 0, 0]
    assert swish == pytest.approx(want * np.clip(want + 3, 0, 6) / 6, rel=1e-6)


@pytest.mark.parametrize("kind", [None, "relu", "hardswish"])
@pytest.mark.parametrize(
    "shape", [(3, 5, 7, 9), (32, 8, 16, 16), (2, 300, 4, 5), (7, 1, 3, 1)]
)
def test_values_and_slopes_are_pytorchs_in_double_precision(kind, shape):
    """To 1e-6 of each; of single precision's own steps 1e-5 and, where a number lies at
    an edge, 1e-3.
    """
    x, weight, bias, after = drawn(shape, mean=3.0, spread=2.0)
    found = slopes(normed.batch_norm, x, weight, bias, after, kind)
    want = slopes(plain, *(part.double() for part in (x, weight, bias, after)), kind)
    for mine, other in zip(found, want, strict=True):
        assert float((mine - other).norm() / other.norm()) < 1e-6


@pytest.mark.parametrize("kind", [None, "hardswish"])
def test_slopes_are_differences_of_values_in_double_precision(kind):
    x, weight, bias, after = drawn((4, 3, 5, 6))
    _, *found = slopes(normed.batch_norm, x, weight, bias, after, kind)
    given = [part.double() for part in (x, weight, bias)]
    for which, slope in enumerate(found):
        along = torch.randn(
            given[which].shape, generator=torch.Generator().manual_seed(which)
        ).double()
        ends = []
        for sign in (1, -1):
            moved = [
                part + sign * 1e-5 * along if i == which else part
                for i, part in enumerate(given)
            ]
            ends.append((plain(*moved, kind) * after).sum())
        assert float((slope * along).sum()) == pytest.approx(
            float(ends[0] - ends[1]) / 2e-5, rel=2e-6
        )


def test_a_mean_of_many_spreads_costs_no_digits_beyond_those_of_the_frames():
    """Spread of 1 about 4096: frames hold 2e-4 of it, and the variance is theirs."""
    x, weight, bias, _ = drawn((8, 6, 16, 16), mean=4096.0)
    made, want = (
        normed.batch_norm(x, weight, bias, None),
        plain(*(part.double() for part in (x, weight, bias)), None),
    )
    assert (
        float((made - want).abs().max()) < 2e-3
    )  # a x + b in single precision, each 4096 weights
    narrow = made.std((0, 2, 3)) / weight.abs()
    assert narrow.numpy() == pytest.approx(1.0, rel=1e-3)


def test_what_is_no_number_stays_none():
    """In values and in slopes: a step that is not finite must be seen."""
    for kind in (None, "relu", "hardswish"):
        x, weight, bias, after = drawn((2, 3, 4, 4))
        x[0, 1, 2, 3] = float("nan")
        y, to_x, to_weight, to_bias = slopes(
            normed.batch_norm, x, weight, bias, after, kind
        )
        for part in (y[:, 1], to_x[:, 1], to_weight[1]):
            assert part.isnan().all()
        assert y[:, 0].isfinite().all()
        assert to_x[:, 2].isfinite().all()
        after[0, 0, 0, 0] = float("inf")
        y, to_x, to_weight, to_bias = slopes(
            normed.batch_norm, x, weight, bias, after, None
        )
        assert not to_x[:, 0].isfinite().all()
        assert not to_bias[0].isfinite()


def test_bytes_are_the_same_for_one_thread_and_two_and_for_either_order_of_memory():
    x, weight, bias, after = drawn((5, 12, 33, 17))
    kept = torch.get_num_threads()
    try:
        found = []
        for count, given in ((1, x), (2, x), (2, x.contiguous())):
            torch.set_num_threads(count)
            found.append(
                slopes(normed.batch_norm, given, weight, bias, after, "hardswish")
            )
    finally:
        torch.set_num_threads(kept)
    for other in found[1:]:
        assert all(
            torch.equal(mine, theirs)
            for mine, theirs in zip(found[0], other, strict=True)
        )


def test_few_values_and_double_precision_take_pytorchs_steps(monkeypatch):
    """And a channel of one value is refused there."""
    x, weight, bias, _ = drawn((3, 4, 5, 6))
    monkeypatch.setattr(normed, "_LEAST", x.numel() + 1)
    assert torch.equal(
        normed.batch_norm(x, weight, bias, "relu"), plain(x, weight, bias, "relu")
    )
    monkeypatch.setattr(normed, "_LEAST", 1)
    wide = [part.double() for part in (x, weight, bias)]
    assert torch.equal(normed.batch_norm(*wide, "hardswish"), plain(*wide, "hardswish"))
    monkeypatch.setattr(normed, "_LEAST", 100)
    with pytest.raises(ValueError, match="more than 1 value per channel"):
        normed.batch_norm(torch.ones(1, 4, 1, 1), torch.ones(4), torch.ones(4), None)
