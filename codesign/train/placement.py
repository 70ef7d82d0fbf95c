"""Where the network computes: on the processor, or on a GPU while scenes, optics and sensor stay on the processor.

Frames go to the network's device as they enter it and its answers come back, so nothing else of a run knows of devices,
and gradients pass through to lens and pitch. A GPU sums in another order than the processor: two runs on one are equal
to rounding, not to the bit.
"""

import os
from typing import Any

import torch
from torch import Tensor, nn

from codesign.network import Prediction
from codesign.train.inner import Trainer
from codesign.train.words import Place
from metalens.ground.errors import ConfigError


def device_of(wanted: Place) -> torch.device:
    """The device of a choice: under ``torchrun`` each process takes the GPU of its local number.

    Raises:
        ConfigError: a GPU is asked for where PyTorch finds none.
    """
    found = torch.cuda.is_available()
    if wanted == "cuda" and not found:
        raise ConfigError(
            "device 'cuda': PyTorch finds no GPU here; install a build of torch with CUDA, or give --device cpu"
        )
    if wanted == "cpu" or not found:
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())


def place(trainer: Trainer, device: torch.device) -> None:
    """Move a trainer's network, and what its optimiser remembers, to a device."""
    if device.type == "cpu":
        return
    torch.backends.cudnn.deterministic = True
    net = trainer.model.net
    net.to(device)
    for optimiser in trainer.optimisers.values():
        optimiser.load_state_dict(optimiser.state_dict())  # casts what it holds to its parameters' devices
    attend(net, device)


def attend(net: nn.Module, device: torch.device) -> None:
    """From now on frames on the processor are taken to ``device``, and predictions there are brought back."""

    def enter(_: nn.Module, given: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(v.to(device) if isinstance(v, Tensor) and v.device.type == "cpu" else v for v in given)

    def leave(_: nn.Module, __: tuple[Any, ...], answer: Prediction) -> Prediction:
        parts = (getattr(answer, name) for name in Prediction.__slots__)
        return Prediction(*(part.cpu() if part is not None and part.device == device else part for part in parts))

    net.register_forward_pre_hook(enter)
    net.register_forward_hook(leave)
