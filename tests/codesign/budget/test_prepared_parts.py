"""What a bench reads of two optics, by sums over pixels."""

import numpy as np
import pytest
import torch

from codesign.budget import task
from codesign.budget.prepared import Bench
from metalens.image import Frames

SETTING = task.TaskSetting(scenes=2, pixels=3, margin=0, pitch_um=4.1)


def test_the_shift_between_two_optics_is_what_the_estimator_makes_of_the_difference_of_their_images():
    """Optics that scale the light of each scene; an image with itself makes none, and
    there and back are opposite.
    """
    draw = torch.Generator().manual_seed(7)
    light = torch.rand((2, 2, 3, 3), generator=draw) + 0.4
    anchor = Frames(light, torch.ones_like(light), torch.full_like(light, 5e3))
    pull = torch.rand((2, 4, 9), generator=draw, dtype=torch.float64) - 0.3
    still = torch.full((2, 9), 11.0, dtype=torch.float64)
    reader = task.Linear(still, pull, torch.eye(4).expand(2, 4, 4))
    rest = dict.fromkeys(Bench.__dataclass_fields__)
    bench = Bench(
        **rest | {"setting": SETTING, "eyes": task.Views(anchor, ()), "reader": reader}
    )
    one, other = (
        lambda frames, share=share: share * frames.radiance[:, 0]
        for share in (0.7, 0.2)
    )
    images = [
        task.electrons(anchor, optics, SETTING).numpy() for optics in (one, other)
    ]
    want = np.einsum("skp,sp->sk", pull.numpy(), images[0] - images[1])
    assert bench.shift(one, other).numpy() == pytest.approx(want, rel=1e-9)
    assert bench.shift(other, one).numpy() == pytest.approx(-want, rel=1e-9)
    assert not bench.shift(one, one).any()
