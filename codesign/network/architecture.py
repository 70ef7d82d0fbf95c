"""The search space: elastic MobileNetV3 backbones as plain records (paper Sec. 3.3)."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from codesign.settings import LARGEST, LEAST, check_ranges
from metalens.core.errors import ConfigError

Activation = Literal["relu", "hardswish"]


@dataclass(frozen=True, slots=True)
class StageSpace:
    """A run of blocks of equal width; the first one strides.

    channels: at width 1.
    squeeze: whether the blocks carry squeeze-and-excitation.
    stride: of its first block. activation: after its convolutions.
    """

    channels: int
    stride: int
    squeeze: bool
    activation: Activation


@dataclass(frozen=True, slots=True)
class BlockSpec:
    """One inverted residual: expand 1x1, depthwise k x k, squeeze-excite, project 1x1.

    squeeze: channels inside squeeze-and-excitation, 0 for none.
    """

    kernel: int
    inputs: int
    hidden: int
    outputs: int
    stride: int
    squeeze: int
    activation: Activation

    @property
    def residual(self) -> bool:
        """Whether the input is added to the output."""
        return self.stride == 1 and self.inputs == self.outputs


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """Everything that can vary, and what stays.

    resolution: (least, largest) scale of the input; the search moves in steps of 0.1,
    training in any.
    stem_channels: of the first convolution. stages: runs of blocks. kernels: sizes of
    convolutions to choose from.
    expansions: widening inside a block. depths: blocks of a stage. widths: factors of
    the channels.
    """

    stem_channels: int = field(default=16, metadata={"above": 0})
    stages: tuple[StageSpace, ...] = (
        StageSpace(24, 2, False, "relu"),
        StageSpace(40, 2, True, "relu"),
        StageSpace(80, 2, False, "hardswish"),
        StageSpace(112, 1, True, "hardswish"),
        StageSpace(160, 1, True, "hardswish"),
    )
    kernels: tuple[int, ...] = (3, 5, 7)
    expansions: tuple[int, ...] = (3, 4, 6)
    depths: tuple[int, ...] = (2, 3, 4)
    widths: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)
    resolution: tuple[float, float] = (0.3, 1.0)

    def __post_init__(self) -> None:
        check_ranges(
            self, widths=(LEAST, LARGEST), depths=(1, LARGEST), expansions=(1, LARGEST)
        )
        low, high = self.resolution
        if not 0 < low <= high <= 1 or any(k < 1 or k % 2 == 0 for k in self.kernels):
            raise ConfigError(
                f"space: resolution = {self.resolution}, kernels = {self.kernels}: "
                "need 0 < least <= largest <= 1 and odd kernels"
            )

    @property
    def slots(self) -> int:
        """Blocks of the deepest architecture."""
        return len(self.stages) * max(self.depths)


@dataclass(frozen=True, slots=True)
class Architecture:
    """One member of the space.

    depths: blocks of each stage.
    kernels, expansions: of every slot (stages x deepest); slots beyond a stage's depth
    are idle.
    width: channel multiplier. resolution: input scale.
    """

    depths: tuple[int, ...]
    kernels: tuple[int, ...]
    expansions: tuple[int, ...]
    width: float = 1.0
    resolution: float = 1.0


def round_channels(channels: float) -> int:
    """Channels rounded to a multiple of 8, at least 0.9 of the given number (MobileNet
    convention).

    Args:
        channels: number before rounding.
    """
    rounded = max(8, int(channels + 4) // 8 * 8)
    return rounded + 8 if rounded < 0.9 * channels else rounded


def stem_channels(space: SearchSpace, architecture: Architecture) -> int:
    """Channels after the first convolution.

    Args:
        space: architectures to choose from. architecture: member of the search space.
    """
    return round_channels(space.stem_channels * architecture.width)


def active_blocks(
    space: SearchSpace, architecture: Architecture
) -> list[list[BlockSpec]]:
    """Sizes of the active blocks, a list for each stage.

    The first block of a stage has its stride; channels are rounded to multiples of 8.

    Args:
        space: architectures to choose from. architecture: member of the search space.
    """
    inputs = stem_channels(space, architecture)
    deepest = max(space.depths)
    result = []
    for i, (stage, depth) in enumerate(
        zip(space.stages, architecture.depths, strict=True)
    ):
        row = []
        for j in range(depth):
            slot = i * deepest + j
            hidden = round_channels(inputs * architecture.expansions[slot])
            outputs = round_channels(stage.channels * architecture.width)
            squeeze = round_channels(hidden / 4) if stage.squeeze else 0
            stride = stage.stride if j == 0 else 1
            row.append(
                BlockSpec(
                    architecture.kernels[slot],
                    inputs,
                    hidden,
                    outputs,
                    stride,
                    squeeze,
                    stage.activation,
                )
            )
            inputs = outputs
        result.append(row)
    return result


def largest_architecture(space: SearchSpace) -> Architecture:
    """The member that holds all others as slices.

    Args:
        space: architectures to choose from.
    """
    return _uniform(space, max)


def smallest_architecture(space: SearchSpace) -> Architecture:
    """The cheapest member.

    Args:
        space: architectures to choose from.
    """
    return _uniform(space, min)


def sample_architecture(
    space: SearchSpace, generator: np.random.Generator
) -> Architecture:
    """A member drawn evenly over every choice.

    Args:
        space: architectures to choose from. generator: of the draws.
    """
    return Architecture(
        depths=tuple(int(v) for v in generator.choice(space.depths, len(space.stages))),
        kernels=tuple(int(v) for v in generator.choice(space.kernels, space.slots)),
        expansions=tuple(
            int(v) for v in generator.choice(space.expansions, space.slots)
        ),
        width=float(generator.choice(space.widths)),
        resolution=float(generator.choice(search_resolutions(space))),
    )


def mutate_architecture(
    space: SearchSpace,
    architecture: Architecture,
    generator: np.random.Generator,
    *,
    rate: float = 0.15,
) -> Architecture:
    """A mutation: every entry is drawn anew with probability ``rate``.

    Where no active entry changed, again with a probability that rises to 1. The only
    member of a space is returned itself.

    Args:
        space: architectures to choose from. architecture: member of the search space.
        generator: of the draws. rate: probability per entry.
    """
    own = canonical_architecture(space, architecture)
    for least in np.linspace(0, 1, 200):
        other = sample_architecture(space, generator)
        chance = max(rate, float(least))
        child = Architecture(
            *(
                _recombine(
                    getattr(architecture, name), getattr(other, name), generator, chance
                )
                for name in Architecture.__slots__
            )
        )
        if canonical_architecture(space, child) != own:
            return child
    return architecture


def search_resolutions(space: SearchSpace) -> tuple[float, ...]:
    """The input scales that the search tries, in steps of 0.1.

    Args:
        space: architectures to choose from.
    """
    low, high = space.resolution
    count = int((high - low) / 0.1 + 1e-9) + 1
    return tuple(round(low + 0.1 * i, 3) for i in range(count))


def canonical_architecture(
    space: SearchSpace, architecture: Architecture
) -> Architecture:
    """The same network with every idle slot set to the smallest choice.

    Equal networks then compare equal.

    Args:
        space: architectures to choose from. architecture: member of the search space.
    """
    used = [
        j < depth for depth in architecture.depths for j in range(max(space.depths))
    ]
    return replace(
        architecture,
        kernels=tuple(
            k if u else min(space.kernels)
            for k, u in zip(architecture.kernels, used, strict=True)
        ),
        expansions=tuple(
            e if u else min(space.expansions)
            for e, u in zip(architecture.expansions, used, strict=True)
        ),
    )


def _uniform(space: SearchSpace, pick: Callable[[Any], Any]) -> Architecture:
    """The member with ``pick`` (max or min) of every choice."""
    return Architecture(
        depths=(pick(space.depths),) * len(space.stages),
        kernels=(pick(space.kernels),) * space.slots,
        expansions=(pick(space.expansions),) * space.slots,
        width=pick(space.widths),
        resolution=pick(space.resolution),
    )


def _recombine(
    mine: Any, others: Any, generator: np.random.Generator, rate: float
) -> Any:
    """The other value with probability ``rate``, entry by entry of a tuple."""
    if isinstance(mine, tuple):
        pairs = zip(mine, others, strict=True)
        return tuple(_recombine(a, b, generator, rate) for a, b in pairs)
    return others if generator.random() < rate else mine
