"""Small parts of the networks in closed form: centres of mass, scaled frames, a cost between whole sizes."""

import numpy as np
import pytest
import torch

from codesign.network import cost, supernet


def test_a_centre_counts_probabilities_above_a_twentieth_by_what_they_exceed_it():
    """Two pixels of 0.55 and 0.15 in a sea of 0.04: weights 0.5 and 0.1, middles of their pixels as shares."""
    probability = torch.full((1, 4, 10), 0.04, dtype=torch.float64)
    probability[0, 0, 8], probability[0, 3, 1] = 0.55, 0.15
    x, y = supernet.soft_argmax(torch.logit(probability))[0].tolist()
    assert x == pytest.approx((0.5 * (8.5 / 10 - 0.5) + 0.1 * (1.5 / 10 - 0.5)) / 0.6, rel=1e-4)
    assert y == pytest.approx((0.5 * (0.5 / 4 - 0.5) + 0.1 * (3.5 / 4 - 0.5)) / 0.6, rel=1e-4)


def test_frames_are_averaged_by_whole_factors_and_then_drawn_between():
    frames = torch.arange(48.0).reshape(1, 1, 6, 8)
    half = supernet.scaled(frames, 0.5)
    assert half[0, 0].tolist() == frames[0, 0].reshape(3, 2, 4, 2).mean((1, 3)).tolist()
    odd = supernet.resampled(frames, (4, 3))  # 8 to 4 by pairs, then 4 to 3; 6 to 4 as they are
    pooled = frames[0, 0].reshape(6, 4, 2).mean(2).numpy()
    for i in range(4):
        for j in range(3):
            y, x = (i + 0.5) * 6 / 4 - 0.5, (j + 0.5) * 4 / 3 - 0.5
            a, b = int(y), int(x)
            c, d = min(a + 1, 5), min(b + 1, 3)
            u, v = y - a, x - b
            want = (1 - u) * ((1 - v) * pooled[a, b] + v * pooled[a, d]) + u * (
                (1 - v) * pooled[c, b] + v * pooled[c, d]
            )
            assert float(odd[0, 0, i, j]) == pytest.approx(want, rel=1e-5)


def test_a_cost_counts_the_pixels_of_every_stride_rounded_up():
    made = cost.Cost({2: 7, 8: 11}, 130)
    for size in (16, 17, 33):
        want = 7 * int(np.ceil(size / 2)) ** 2 + 11 * int(np.ceil(size / 8)) ** 2 + 130
        assert int(made.at(size)) == want
    assert made.at(np.array([16, 33])).tolist() == [7 * 64 + 11 * 4 + 130, 7 * 17**2 + 11 * 25 + 130]


def test_a_backbone_costs_its_stem_and_its_blocks_at_their_own_strides():
    """Stem 1 to 6 by 5 x 5 at stride 2; a block without expansion; one with, of stride 2 and a squeeze of 3."""
    from codesign.network.architecture import Block

    fields = Block.__dataclass_fields__
    about = {name: 0 for name in fields}
    first = Block(**(about | {"inputs": 6, "hidden": 6, "outputs": 10, "kernel": 3, "stride": 1, "squeeze": 0}))
    second = Block(**(about | {"inputs": 10, "hidden": 24, "outputs": 14, "kernel": 5, "stride": 2, "squeeze": 3}))
    made = cost.backbone(6, [first, second], stem_kernel=5)
    assert made.per_pixel == {2: 6 * 25 + 6 * (9 + 10) + 10 * 24, 4: 24 * (25 + 14)}
    assert made.constant == 2 * 24 * 3


def test_an_input_has_the_pixels_of_its_window():
    assert cost.input_size(900.0, 12.0, 0.6) == pytest.approx(45.0)
    assert cost.coarsest_um(900.0, 0.6) == pytest.approx(33.75)
