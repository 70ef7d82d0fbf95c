"""Settings that command lines show; they need neither torch nor time."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError

Part = Literal["optics", "pitch", "architecture"]
Place = Literal["auto", "cpu", "cuda"]
LEAST, LARGEST = 1e-9, 1e9  # of numbers above 0 and without another limit


def check_ranges(record: Any, **limits: tuple[float, float]) -> None:
    """Refuse numbers of a settings record that lie outside their limits.

    Args:
        record: its fields are numbers, tuples of numbers, or None where left out.
        limits: (least, largest) by name of the field.

    Raises:
        ConfigError: the field, its value and what is needed.
    """
    for name, (least, largest) in limits.items():
        value = getattr(record, name)
        if value is not None and not all(
            least <= v <= largest for v in np.ravel(value)
        ):
            need = "above 0" if least == LEAST else f"{least:g} or more"
            if largest < LARGEST:
                need = f"{least:g} to {largest:g}"
            raise ConfigError(f"{name} = {value}: need {need}")


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
        counts = ("steps", "draws", "judge", "test_batches")
        check_ranges(self, **dict.fromkeys(counts, (1, LARGEST)))
        check_ranges(self, seed=(0, LARGEST), rate=(LEAST, LARGEST))


@dataclass(frozen=True, slots=True)
class ExperimentConfig:
    """What is shown to whom, and how gaze is calibrated.

    subjects: their number. grid: stimuli (across, down). field_deg: (across, down) that
    they span.
    axial_mm, lateral_mm: slippage states besides the origin, along z and x.
    share: of the stimuli that a subject is calibrated on, drawn at random; the rest is
    judged.
    people: who calibrated before; their readings give the
    prior of every subject.
    calibrator: of gaze: "mixed-model", learned on these people, or "sphere", the
    spherical-eye solver with a residual regressor, which also serves networks that
    predict no axis. The table holds both. hidden: neurons of the regressor.
    fixation_deg: standard deviation of where a subject really looks.
    image: "true", what the device shows, whatever the run was trained on; "trained",
    the image that the run knows.
    pupil_sd: relative change of the pupil's radius from frame to frame. seed: of
    subjects, fixation and calibration.
    snr_db: dim light under a strong ambient one, so that a pixel of the first run has
    this signal-to-noise ratio behind a lens that images all light; the exposure and the
    background are the same for every run. None for good light.
    """

    subjects: int = 20
    grid: tuple[int, int] = (7, 7)
    field_deg: tuple[float, float] = (35.0, 25.0)
    axial_mm: tuple[float, ...] = (-5.0, -2.5, 2.5, 5.0)
    lateral_mm: tuple[float, ...] = (-2.5, -5.0)
    share: float = 0.2
    people: int = 32
    calibrator: Literal["mixed-model", "sphere"] = "mixed-model"
    hidden: int = 10
    fixation_deg: float = 0.3
    pupil_sd: float = 0.05
    seed: int = 0
    snr_db: float | None = None
    image: Literal["true", "trained"] = "true"

    def __post_init__(self) -> None:
        points = self.grid[0] * self.grid[1]
        if (
            self.subjects < 1
            or min(self.grid) < 2
            or not 3 <= round(self.share * points) < points
        ):
            raise ConfigError(
                f"subjects {self.subjects}, grid {self.grid}, share {self.share}: need a "
                "subject, 2 x 2 stimuli, 3 of them to calibrate on, and some to judge"
            )
        rest = ("hidden", "seed", "fixation_deg", "pupil_sd")
        check_ranges(self, **dict.fromkeys(rest, (0, LARGEST)))
        check_ranges(self, people=(2, LARGEST), field_deg=(LEAST, 119))

    @property
    def stimuli_deg(self) -> Array:
        """(points, 2) direction of every stimulus, x and y (down)."""
        x, y = (
            np.linspace(-f / 2, f / 2, n)
            for f, n in zip(self.field_deg, self.grid, strict=True)
        )
        return np.stack([g.ravel() for g in np.meshgrid(x, y)], 1)

    @property
    def slips_mm(self) -> Array:
        """(states, 3): the origin, the lateral and the axial ones."""
        lateral = [(x, 0.0, 0.0) for x in self.lateral_mm]
        return np.array(
            [(0.0, 0.0, 0.0), *lateral, *((0.0, 0.0, z) for z in self.axial_mm)]
        )

    @property
    def frames(self) -> int:
        """Of all subjects."""
        return self.subjects * len(self.stimuli_deg) * len(self.slips_mm)
