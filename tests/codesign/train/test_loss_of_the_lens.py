"""When a step counts the lens' own loss: where the lens moves and the loss has a
weight, and else not.
"""

from types import SimpleNamespace

import pytest
import torch

from codesign.train import inner
from codesign.train.inner import Trainer


@pytest.mark.parametrize("stacks", [False, True])
@pytest.mark.parametrize(("live", "weight"), [(True, 0.07), (True, 0.0), (False, 0.07)])
def test_the_loss_of_the_lens_is_counted_where_it_moves_and_weighs(
    monkeypatch, live, weight, stacks
):
    """A stack of a loss of 3.2, and light that knows stacks of its own, whose loss is
    counted with it.
    """
    made, frames = [], torch.zeros(2, 5, 6)
    monkeypatch.setattr(inner, "samples", lambda given: 6)
    monkeypatch.setattr(
        inner.lens, "stack", lambda optics, x, error: made.append(error) or "made"
    )
    monkeypatch.setattr(
        inner,
        "depth_loss",
        lambda one, optics, energy: torch.tensor(3.2 if one == "made" else 0.0),
    )
    light = SimpleNamespace(
        stacks=stacks, at=lambda step, x, count, margin, live: ("light", step, live)
    )
    one = SimpleNamespace(
        model=SimpleNamespace(coefficients_rad=torch.ones(3)), light=light, scenes=SimpleNamespace(margin=4),
        inner=SimpleNamespace(optics_weight=weight, energy=0.9), optics="lens",
        _lens_error=lambda step: f"error {step}",
    )  # fmt: skip
    optics, loss = Trainer._light(one, 17, frames, live)
    counted = live and weight > 0 and not stacks
    assert optics == ("light", 17, live)
    assert float(loss) == pytest.approx(3.2 * counted)
    assert made == ["error 17"] * counted
