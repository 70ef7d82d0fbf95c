"""Where a run computes: on the processor, or on a GPU while the processor renders the
frames of the next step.
"""

import os
from typing import Any

import torch
from torch import Tensor, nn

from codesign.network import Prediction
from codesign.train.inner import Trainer
from codesign.train.words import Place
from metalens.core.errors import ConfigError


def device_of(wanted: Place) -> torch.device:
    """The device of a choice: under ``torchrun`` each process takes the GPU of its
    local number.

    Args:
        wanted: "auto", "cpu" or "cuda".

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
    return torch.device(
        "cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count()
    )


def place_on_device(trainer: Trainer, device: torch.device) -> None:
    """Let a trainer image and train on a device: its network and what its optimiser
    remembers move there.
    """
    if device.type == "cpu":
        return
    trainer.light.device = device
    torch.backends.cudnn.deterministic = True
    net = trainer.model.net
    net.to(device)
    for optimiser in trainer.optimisers.values():
        optimiser.load_state_dict(
            optimiser.state_dict()
        )  # casts what it holds to its parameters' devices
    follow_device(net, device)


def follow_device(net: nn.Module, device: torch.device) -> None:
    """From now on frames on the processor are taken to ``device``, and what is
    predicted of those is brought back.

    Args:
        net: network.
    """
    brought = False

    def enter(_: nn.Module, given: tuple[Any, ...]) -> tuple[Any, ...]:
        nonlocal brought
        brought = any(isinstance(v, Tensor) and v.device.type == "cpu" for v in given)
        return tuple(v.to(device) if isinstance(v, Tensor) else v for v in given)

    def leave(_: nn.Module, __: tuple[Any, ...], answer: Prediction) -> Prediction:
        parts = (getattr(answer, name) for name in Prediction.__slots__)
        return Prediction(
            *(part.cpu() if brought and part is not None else part for part in parts)
        )

    net.register_forward_pre_hook(enter)
    net.register_forward_hook(leave)
