"""One architecture cut out of a supernet, to be kept: it holds only the weights that it
uses.
"""

from collections.abc import Mapping
from operator import gt
from typing import Any

from torch import Tensor, nn

from codesign.network.architecture import (
    Architecture,
    BlockSpec,
    active_blocks,
    stem_channels,
)
from codesign.network.cost import MASK_CHANNELS, SLIP_CHANNELS, lateral_strides
from codesign.network.supernet import ElasticBlock, Supernet, modules_of
from metalens.core.errors import TrainingError


class Subnet(nn.Module):
    """One architecture cut out of a supernet: ``forward(frames) -> (mask_logits,
    centre, slip)``.

    It holds only the weights that it uses; outputs equal those of the recalibrated
    supernet.
    """

    def __init__(self, net: Supernet, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        self.net = Supernet(net.space)
        self.net.load_state_dict(net.state_dict())
        _trim(self.net, architecture)
        self.eval()

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = self.net(frames, self.architecture)
        return found.mask_logits, found.centre, found.slip


def restore_weights(net: Supernet, state: Mapping[str, Tensor]) -> None:
    """Copy the weights of a saved :class:`Subnet` into the supernet it was cut from.

    To the leading channels and central kernels, as they were cut; all other weights
    stay.

    Args:
        net: elastic network. state: weights by name of :meth:`Subnet.state_dict`.

    Raises:
        TrainingError: a weight that the supernet lacks, or one larger than its own.
    """
    weights = net.state_dict()
    for name, saved in state.items():
        own_name = name.removeprefix("net.")
        target = weights.get(own_name)
        fits = target is not None and target.dim() == saved.dim()
        if target is None or not fits or any(map(gt, saved.shape, target.shape)):
            raise TrainingError(
                f"weight {own_name!r} is no part of this run's network: its space differs"
            )
        leading = [slice(0, n) for n in saved.shape[:2]]
        central = [
            slice((most - n) // 2, (most - n) // 2 + n)
            for most, n in zip(target.shape[2:], saved.shape[2:], strict=True)
        ]
        target[(*leading, *central)] = saved
    net.load_state_dict(weights)


def _trim(net: Supernet, architecture: Architecture) -> None:
    """Cut all weights of a supernet to those that ``architecture`` uses, in place."""
    rows = active_blocks(net.space, architecture)
    stem = stem_channels(net.space, architecture)
    _trim_conv(net.stem, 1, stem, 3)
    for stage, row in zip(net.stages, rows, strict=True):
        modules = list(modules_of(stage))
        for module, block in zip(modules, row, strict=False):
            _trim_block(module, block)
        del stage[len(row) :]  # type: ignore[operator]
    channels_of_stages = [
        rows[stage][-1].outputs for stage, _ in lateral_strides(net.space)
    ]
    for lateral, channels in zip(
        net.perception.laterals, channels_of_stages, strict=True
    ):
        _trim_conv(lateral, channels, MASK_CHANNELS, 1)
    _trim_conv(net.calibration.reduce, rows[-1][-1].outputs, SLIP_CHANNELS, 1)


def _trim_block(module: ElasticBlock, block: BlockSpec) -> None:
    """Cut the weights of a block to the sizes of ``block``, in place."""
    _trim_conv(module.expand, block.inputs, block.hidden, 1)
    _trim_conv(module.depthwise, 1, block.hidden, block.kernel)
    _trim_conv(module.project, block.hidden, block.outputs, 1)
    if module.squeeze is not None:
        down, up = module.squeeze.down, module.squeeze.up
        _keep(
            down,
            weight=down.weight[: block.squeeze, : block.hidden],
            bias=down.bias[: block.squeeze],
        )
        _keep(
            up,
            weight=up.weight[: block.hidden, : block.squeeze],
            bias=up.bias[: block.hidden],
        )


def _trim_conv(conv: Any, inputs: int, outputs: int, kernel: int) -> None:
    """Cut a convolution to its leading channels and central kernel, in place."""
    border = (conv.weight.shape[-1] - kernel) // 2
    window = slice(border, border + kernel)
    _keep(conv, weight=conv.weight[:outputs, :inputs, window, window])
    norm = conv.norm
    _keep(norm, weight=norm.weight[:outputs], bias=norm.bias[:outputs])
    norm.mean, norm.variance = (
        norm.mean[:outputs].clone(),
        norm.variance[:outputs].clone(),
    )


def _keep(module: nn.Module, **tensors: Tensor) -> None:
    """Replace parameters of a module by copies of ``tensors``."""
    for name, tensor in tensors.items():
        setattr(module, name, nn.Parameter(tensor.detach().clone()))
