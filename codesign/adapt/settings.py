"""How a network is trained on."""

from dataclasses import dataclass

from metalens.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class RetrainConfig:
    """How to train on.

    steps: of the inner loop; its batch and loss weights are those of the run. rate:
    largest learning rate.
    draws: lenses from the posterior that training sees; judge: other ones that judge it
    where the truth is not known.
    test_batches: frames that judge, in batches of the run. seed: of draws, frames and
    noise.
    budget_mmacs: which network of the run; 0 for the one of the largest budget.
    """

    steps: int = 200
    rate: float = 1.5e-3
    draws: int = 8
    judge: int = 4
    test_batches: int = 16
    seed: int = 0
    budget_mmacs: float = 0.0

    def __post_init__(self) -> None:
        if (
            min(self.steps, self.draws, self.judge, self.test_batches) < 1
            or self.seed < 0
            or not self.rate > 0
        ):
            raise ConfigError(
                f"{self}: need steps, draws, judge and test_batches of 1 or more, a seed of 0 or more, a rate above 0"
            )
