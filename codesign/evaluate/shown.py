"""What a virtual experiment shows to whom, and what comes of it."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError

if TYPE_CHECKING:
    from codesign.gaze import PersonCalibrator

Points = Literal["random", "spread"]
AXIAL, LATERAL = "axial", "lateral"


@dataclass(frozen=True, eq=False, slots=True)
class ExperimentTrials:
    """Of every frame (n,): subject, stimulus, slippage state; and what was true.

    stimulus_deg: (n, 2). slip_mm: (n, 3).
    """

    subject: Array
    stimulus: Array
    state: Array
    stimulus_deg: Array
    slip_mm: Array

    def group(self, kind: str) -> Array:
        """(n,) frames of the axial or lateral states, the origin among both.

        Args:
            kind: "axial" or "lateral".
        """
        along = 2 if kind == AXIAL else 0
        other = self.slip_mm[:, [0, 1] if kind == AXIAL else [1, 2]]
        return np.asarray((other == 0).all(1) & np.isfinite(self.slip_mm[:, along]))


@dataclass(frozen=True, slots=True)
class ExperimentConfig:
    """What is shown to whom, and how gaze is calibrated.

    subjects: their number. grid: stimuli (across, down). field_deg: (across, down) that
    they span.
    axial_mm, lateral_mm: slippage states beside the origin, along z and x.
    share: of the stimuli that a subject is calibrated on; the rest is judged. points:
    whether these stimuli are drawn
        at random or spread over the field, as a calibration screen would show them.
    people: who calibrated before, and tell what readings mean for all of them: the
    prior of every subject.
    hidden: neurons of the regressor, of networks that tell no axis.
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
    points: Points = "random"
    people: int = 32
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
                f"subjects {self.subjects}, grid {self.grid}, share {self.share}: need a subject, a grid of 2 x 2 or "
                "more, and a share that leaves 3 or more stimuli to calibrate on and some to judge"
            )
        if self.people < 2:
            raise ConfigError(
                f"people {self.people}: need two or more, to tell how people differ"
            )
        if min(self.hidden, self.seed, self.fixation_deg, self.pupil_sd) < 0:
            raise ConfigError(
                f"hidden {self.hidden}, seed {self.seed}, fixation_deg {self.fixation_deg:g}, pupil_sd "
                f"{self.pupil_sd:g}: need 0 or more"
            )
        if not all(0 < field < 120 for field in self.field_deg):
            raise ConfigError(
                f"field_deg {self.field_deg}: need two angles above 0 and below 120, as eyes turn"
            )

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


@dataclass(frozen=True, eq=False, slots=True)
class RunResult:
    """One run in the experiment.

    slip_mm: (n, 3) as read. centre: (n, 2) pupil, fraction of the image. iou: (n,).
    gaze_deg: (n,) error of the
    calibrated gaze, nan for frames that calibrated. predicted_deg: (n, 2). told_deg:
    (n,) the same error where sphere
    and regressor are given the pupil as read and the true slippage: what the pupil
    alone leaves. reach_mm: largest
    slippage along x, y, z that the run's training saw. how: subjects were calibrated.
    visible_mm: (n, 3) displacement
    of the head as the camera sees it, its own turn on the mount included: all that can
    be read. above: why the error
    of the images is above what the run asks for; empty where it is not. finer: the same
    frames on images formed at a quarter of the run's tolerance, calibrated on those;
    None where they are not known.
    """

    name: str
    mmacs: float
    trial: ExperimentTrials
    slip_mm: Array
    centre: Array
    iou: Array
    gaze_deg: Array
    predicted_deg: Array
    told_deg: Array
    reach_mm: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    how: "PersonCalibrator | None" = None
    visible_mm: Array | None = None
    above: str = ""
    finer: "RunResult | None" = None

    @property
    def within(self) -> Array:
        """(n,) frames whose slippage training saw."""
        return np.asarray((np.abs(self.trial.slip_mm) <= self.reach_mm).all(1))

    def gaze(self, kind: str) -> float:
        """Mean gaze error over the judged frames of a group, deg.

        Args:
            kind: "axial" or "lateral".
        """
        return float(np.nanmean(self.gaze_deg[self.trial.group(kind)]))

    @property
    def slip_error_mm(self) -> Array:
        """(n, 3) absolute errors of the slippage."""
        return np.asarray(np.abs(self.slip_mm - self.trial.slip_mm))

    @property
    def slip_visible_mm(self) -> Array:
        """(n, 3) absolute errors of one who reads the visible displacement exactly; nan
        where it is not known.
        """
        blank = np.full_like(self.trial.slip_mm, math.nan)
        return (
            blank
            if self.visible_mm is None
            else np.asarray(np.abs(self.visible_mm - self.trial.slip_mm))
        )

    @property
    def slip_rest_mm(self) -> Array:
        """(n, 3) absolute errors beside the mean error of the subject's calibration,
        nan for frames that calibrated.

        What is constant of a person (size of the face, and the camera's turn on it) is
        no slippage: a device is zeroed
        where its wearer calibrates.
        """
        error, judged = self.slip_mm - self.trial.slip_mm, np.isfinite(self.gaze_deg)
        out = np.full_like(error, math.nan)
        for subject in np.unique(self.trial.subject):
            mine = self.trial.subject == subject
            out[mine & judged] = np.abs(
                error[mine & judged] - error[mine & ~judged].mean(0)
            )
        return out

    def per_subject(self, values: Array, chosen: Array | None = None) -> Array:
        """(subjects,) means of (n,) values, of which nan are left out; nan where none
        is left.

        Args:
            chosen: (n,) frames that count; all without it.
        """
        keep = np.isfinite(values) if chosen is None else np.isfinite(values) & chosen
        mine = (
            values[keep & (self.trial.subject == s)]
            for s in np.unique(self.trial.subject)
        )
        return np.array([one.mean() if len(one) else math.nan for one in mine])
