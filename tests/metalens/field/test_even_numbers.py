"""Even light by its plain sum over odd windows of unlike sides, and the map of what is
put right.
"""

import pytest
import torch

from metalens.field import even


def test_the_sum_of_even_light_is_that_of_every_source_and_node():
    """I(X) = Σ over nodes and sources x of the frame of E P(X - x) weights(x): counted
    out, kernels of 5 by 3 on 7 by
    4 pixels, whose middle is the source."""
    draw = torch.Generator().manual_seed(3)
    stack = torch.rand(2, 3, 5, 3, generator=draw, dtype=torch.float64)
    energy = torch.rand(2, 3, generator=draw, dtype=torch.float64)
    down, across = (
        torch.rand(n, m, generator=draw, dtype=torch.float64)
        for n, m in ((7, 2), (4, 3))
    )
    want = torch.zeros(7, 4, dtype=torch.float64)
    for y in range(7):
        for x in range(4):
            for dy in range(-2, 3):
                for dx in range(-1, 2):
                    if 0 <= y + dy < 7 and 0 <= x + dx < 4:
                        weights = down[y][:, None] * across[x] * energy
                        want[y + dy, x + dx] += (
                            weights * stack[:, :, dy + 2, dx + 1]
                        ).sum()
    assert torch.allclose(even.light(stack, energy, [down, across]), want, rtol=1e-12)


def test_weights_and_energies_of_another_precision_are_taken_as_the_stack_is():
    stack = torch.ones(2, 2, 3, 3)
    found = even.light(
        stack,
        torch.ones(2, 2, dtype=torch.float64),
        [torch.ones(4, 2, dtype=torch.float64)] * 2,
    )
    assert found.dtype == torch.float32
    assert found[1, 2].item() == pytest.approx(36.0)  # four nodes, nine samples
    assert found[0, 0].item() == pytest.approx(
        16.0
    )  # a corner has no light from beyond


@pytest.mark.parametrize("scale", [1.0, 37.0])
def test_light_is_put_right_where_a_hundredth_of_the_most_is_found(scale):
    """1 + f (w - f) / (f² + ε²), ε a hundredth of the largest wanted in size, whatever
    its sign or unit.
    """
    wanted = scale * torch.tensor([[-4.0, 1.0], [0.06, 0.0]], dtype=torch.float64)
    found = scale * torch.tensor([[-3.0, 0.8], [0.04, 0.03]], dtype=torch.float64)
    got = even.ratio(wanted, found).flatten().tolist()
    assert got[0] == pytest.approx(1 + 3.0 / (9 + 0.0016), rel=1e-12)
    assert got[1] == pytest.approx(1 + 0.8 * 0.2 / (0.64 + 0.0016), rel=1e-12)
    assert got[2] == pytest.approx(1 + 0.04 * 0.02 / (0.0016 + 0.0016), rel=1e-12)
    assert got[3] == pytest.approx(1 - 0.03 * 0.03 / (0.0009 + 0.0016), rel=1e-12)


def test_the_faint_border_has_no_slope_of_its_own():
    """It is no part of what is learned: d ratio / d wanted is f / (f² + ε²) at fixed ε."""
    wanted = torch.tensor([5.0, 0.2], dtype=torch.float64, requires_grad=True)
    found = torch.tensor([4.0, 0.1], dtype=torch.float64)
    (slope,) = torch.autograd.grad(even.ratio(wanted, found).sum(), wanted)
    assert slope.tolist() == pytest.approx(
        [4 / (16 + 0.0025), 0.1 / (0.01 + 0.0025)], rel=1e-12
    )
