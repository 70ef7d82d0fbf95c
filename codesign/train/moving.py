"""What training moves, and how: network weights, phase of the lens, pixel pitch, each
on a schedule of its own.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from codesign.network import SearchSpace, Supernet
from codesign.optics import OpticsConfig
from metalens.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class LearningRateSchedule:
    """How one group of parameters moves: Adam with warm-up, cosine decay, and its own
    clip.

    rate: largest learning rate; 0 keeps the group fixed.
    start, end: part of the run in which it moves.
    clip: largest norm of its gradient.
    """

    rate: float
    start: float = 0.0
    end: float = 1.0
    clip: float = 1.0

    def __post_init__(self) -> None:
        if not (self.rate >= 0 and 0 <= self.start < self.end <= 1 and self.clip > 0):
            raise ConfigError(
                f"{self}: need rate >= 0, 0 <= start < end <= 1, clip > 0"
            )

    def at(self, progress: float) -> float:
        """Learning rate at this part of the run.

        Args:
            progress: part of the run that is over, 0 to 1.
        """
        if not self.start <= progress < self.end:
            return 0.0
        inside = (progress - self.start) / (self.end - self.start)
        return (
            self.rate
            * min(1.0, inside / 0.1 + 0.01)
            * (0.5 + 0.5 * math.cos(math.pi * inside))
        )


@dataclass(eq=False)
class TrainedModel:
    """What training moves.

    coefficients_rad: (polynomials,) of the lens. log_pitch: logarithm of the pixel
    pitch in um. finest_um: pitch below
    which no network of the run keeps its budget; 0 for none.
    """

    net: Supernet
    coefficients_rad: nn.Parameter
    log_pitch: nn.Parameter
    finest_um: float = 0.0

    @property
    def pitch_um(self) -> Tensor:
        """Pixel pitch, always above 0."""
        return self.log_pitch.exp()

    def hold(self, finest_um: float, coarsest_um: float) -> float | None:
        """Bring the pitch back between these; the one that it was held at, None where
        it was between them.

        Args:
            finest_um: least pitch. coarsest_um: largest pitch.
        """
        wanted = float(self.pitch_um.detach())
        with torch.no_grad():
            self.log_pitch.clamp_(math.log(finest_um), math.log(coarsest_um))
        return (
            finest_um
            if wanted < finest_um
            else coarsest_um
            if wanted > coarsest_um
            else None
        )


def make_model(
    settings: OpticsConfig,
    *,
    pitch_um: float,
    seed: int,
    space: SearchSpace | None = None,
) -> TrainedModel:
    """A fresh model: network weights from the seed, a lens without added phase.

    Args:
        settings: of the lens and its image. pitch_um: of the pixels.
        space: architectures to choose from; the default space without it.
    """
    torch.manual_seed(seed)
    net = Supernet(space)
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast on a processor
    return TrainedModel(
        net,
        nn.Parameter(torch.zeros(settings.polynomials, dtype=torch.float64)),
        nn.Parameter(torch.tensor(math.log(pitch_um), dtype=torch.float64)),
    )


def has_finite_gradients(parameters: Iterable[nn.Parameter]) -> bool:
    """Whether all gradients that there are have finite numbers alone; a device is asked
    once.

    Args:
        parameters: with gradients.
    """
    grads = [p.grad for p in parameters if p.grad is not None]
    places = {g.device for g in grads}
    largest = (
        nn.utils.get_total_norm([g for g in grads if g.device == place], math.inf)
        for place in places
    )
    return all(bool(torch.isfinite(one)) for one in largest)


def laid_out(optimiser: torch.optim.Optimizer) -> None:
    """Moments laid out in memory as their parameters: a fused step walks through both
    in one order without asking.

    Args:
        optimiser: with its moments.
    """
    for parameter, kept in optimiser.state.items():
        for name, value in kept.items():
            if (
                isinstance(value, Tensor)
                and name != "step"  # the count of a scalar is no moment of it
                and value.shape == parameter.shape
            ):
                kept[name] = torch.empty_like(parameter).copy_(value)
