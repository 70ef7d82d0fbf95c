"""A trainer that stays on the processor is left as it is."""

from types import SimpleNamespace

import torch

from codesign.train.placement import follow_device, place_on_device


def test_on_the_processor_nothing_is_taken_to_a_device():
    net = torch.nn.Linear(3, 2)
    moved = []
    optimiser = SimpleNamespace(state_dict=dict, load_state_dict=moved.append)
    was = torch.backends.cudnn.deterministic
    place_on_device(
        SimpleNamespace(
            model=SimpleNamespace(net=net), optimisers={"weights": optimiser}
        ),
        torch.device("cpu"),
    )
    assert not moved
    assert not net._forward_pre_hooks
    assert not net._forward_hooks
    assert torch.backends.cudnn.deterministic is was


def test_frames_on_the_processor_are_taken_to_the_device_and_what_else_is_given_stays():
    """A device without numbers stands for a GPU."""
    net, there = torch.nn.Linear(3, 2).to("meta"), torch.device("meta")
    follow_device(net, there)
    (enter,) = net._forward_pre_hooks.values()
    here, moved = torch.ones(4, 3), torch.ones(2, 3, device="meta")
    given = enter(net, (here, moved, "subnet", None))
    assert [given[0].device, given[0].shape] == [there, (4, 3)]
    assert given[1] is moved
    assert given[2:] == ("subnet", None)
