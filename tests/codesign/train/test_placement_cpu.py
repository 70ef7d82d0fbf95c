"""A trainer that stays on the processor is left as it is."""

from types import SimpleNamespace

import torch

from codesign.train.placement import place


def test_on_the_processor_nothing_is_taken_to_a_device():
    net = torch.nn.Linear(3, 2)
    moved = []
    optimiser = SimpleNamespace(state_dict=dict, load_state_dict=moved.append)
    was = torch.backends.cudnn.deterministic
    place(SimpleNamespace(model=SimpleNamespace(net=net), optimisers={"weights": optimiser}), torch.device("cpu"))
    assert not moved
    assert not net._forward_pre_hooks
    assert not net._forward_hooks
    assert torch.backends.cudnn.deterministic is was
