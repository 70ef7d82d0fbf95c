"""The experiment of the paper's Sec. 5 with synthetic subjects: a grid of stimuli under known slippage of the camera.

The paper's bench holds the head, shows 7 x 7 stimuli over 25 x 35 degrees, and moves the camera to seven places that
share an origin: two to the side and four along the axis, in steps of 2.5 mm. Here the subjects are drawn from the
population of :mod:`codesign.eye.population`, none of whom training saw; every run sees the same frames through its
own lens.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from codesign.adapt import Source, network
from codesign.batches import EXPERIMENT, EyeScenes, as_batch, irradiance
from codesign.evaluate.shown import ExperimentConfig
from codesign.eye import POPULATION, Rendered, Rig, States, render
from codesign.eye import population as eye
from codesign.gaze import PersonalGaze, angle_deg, personal
from codesign.network import recalibrate
from codesign.optics import formed
from codesign.train import Answers, Seen, assess, read_out
from metalens.ground.arrays import Array
from metalens.ground.errors import ConfigError
from metalens.image import Imager, UniformImager, low_snr

AXIAL, LATERAL = "axial", "lateral"
LOOKS, POINTS, PEOPLE, NOISE = 20, 21, 555, 1_000_003  # streams of the random generator


@dataclass(frozen=True, eq=False, slots=True)
class Trial:
    """Of every frame (n,): subject, stimulus, slippage state; and what was true.

    stimulus_deg: (n, 2). slip_mm: (n, 3).
    """

    subject: Array
    stimulus: Array
    state: Array
    stimulus_deg: Array
    slip_mm: Array

    def group(self, kind: str) -> Array:
        """(n,) frames of the axial or lateral states, the origin among both."""
        along = 2 if kind == AXIAL else 0
        other = self.slip_mm[:, [0, 1] if kind == AXIAL else [1, 2]]
        return np.asarray((other == 0).all(1) & np.isfinite(self.slip_mm[:, along]))


@dataclass(frozen=True, eq=False, slots=True)
class Result:
    """One run in the experiment.

    slip_mm: (n, 3) as read. centre: (n, 2) pupil, fraction of the image. iou: (n,). gaze_deg: (n,) error of the
    calibrated gaze, nan for frames that calibrated. predicted_deg: (n, 2). told_deg: (n,) the same error where the
    regressor is told the true slippage: what the reading of the pupil alone leaves. reach_mm: largest slippage along x,
    y, z that the run's training saw.
    """

    name: str
    mmacs: float
    trial: Trial
    slip_mm: Array
    centre: Array
    iou: Array
    gaze_deg: Array
    predicted_deg: Array
    told_deg: Array
    reach_mm: tuple[float, float, float] = (math.inf, math.inf, math.inf)

    @property
    def within(self) -> Array:
        """(n,) frames whose slippage training saw."""
        return np.asarray((np.abs(self.trial.slip_mm) <= self.reach_mm).all(1))

    def gaze(self, kind: str) -> float:
        """Mean gaze error over the judged frames of a group, deg."""
        return float(np.nanmean(self.gaze_deg[self.trial.group(kind)]))

    @property
    def slip_error_mm(self) -> Array:
        """(n, 3) absolute errors of the slippage."""
        return np.asarray(np.abs(self.slip_mm - self.trial.slip_mm))

    def per_subject(self, values: Array, chosen: Array | None = None) -> Array:
        """(subjects,) means of (n,) values, of which nan are left out."""
        keep = np.isfinite(values) if chosen is None else np.isfinite(values) & chosen
        return np.array([values[keep & (self.trial.subject == s)].mean() for s in np.unique(self.trial.subject)])


def states_of(config: ExperimentConfig, subject: int, scenes: EyeScenes) -> tuple[States, Trial]:
    """All frames of one subject: slippage states outermost, stimuli within."""
    stimuli, slips = config.stimuli_deg, config.slips_mm
    n = len(stimuli) * len(slips)
    rng = np.random.default_rng([config.seed, subject, LOOKS])
    person = eye.draw(1, (config.seed, PEOPLE, subject), motion=replace(scenes.settings.motion, scale=0.0))
    base = person[torch.zeros(n, dtype=torch.int64)]
    state, stimulus = (g.ravel() for g in np.meshgrid(np.arange(len(slips)), np.arange(len(stimuli)), indexing="ij"))
    kappa = torch.stack([base.trait("kappa_x_rad"), base.trait("kappa_y_rad")], 1)
    looks = np.radians(stimuli[stimulus] + config.fixation_deg * rng.standard_normal((n, 2)))
    traits = base.traits.clone()
    radius = list(POPULATION).index("pupil_radius_um")
    traits[:, radius] *= torch.from_numpy(np.clip(1 + config.pupil_sd * rng.standard_normal(n), 0.7, 1.3))
    states = replace(
        base,
        traits=traits,
        gaze_rad=torch.from_numpy(looks) + kappa,  # the visual axis lies nasal of and above the optic axis
        torsion_rad=torch.zeros(n, dtype=torch.float64),
        slip_um=torch.from_numpy(slips[state] * 1e3),
        aperture=torch.from_numpy(np.clip(1 + 0.05 * rng.standard_normal(n), 0.8, 1.15)),
    )
    return states, Trial(np.full(n, subject), stimulus, state, stimuli[stimulus], slips[state])


def through(
    source: Source,
    made: Rendered,
    prepared: UniformImager | Imager,
    *,
    seed: int,
    snr_db: float | None = None,
    quiet: bool = False,
) -> Seen:
    """Rendered frames through a run's lens and sensor, with noise of a seed or ``quiet``; dimmed with ``snr_db``."""
    trainer = source.run.trainer
    margin = source.settings.scenes.margin
    batch = as_batch(made, margin)
    light = irradiance(batch.frames, prepared, margin=margin)
    noise = torch.Generator().manual_seed(seed)
    sensor, pitch = trainer.sensor, trainer.model.pitch_um
    if snr_db is not None:
        at = replace(sensor, pitch_um=float(pitch))
        sensor = replace(low_snr(at, float(light.mean()), snr_db=snr_db), pitch_um=sensor.pitch_um)
    pixels = read_out(light, trainer.optics.sample_um, pitch, sensor, generator=noise, quiet=quiet)
    return Seen(pixels, batch.mask, batch.slip_mm, trainer.inner.batch)


@torch.no_grad()
def experiment(
    sources: Sequence[Source], config: ExperimentConfig, *, names: Sequence[str] | None = None
) -> Iterator[tuple[int, list[Result]]]:
    """Run the experiment, subject by subject.

    Yields:
        (subjects done, one :class:`Result` a run); results are there with the last subject only.

    Raises:
        ConfigError: runs whose frames differ in size, samples or lens distance: they cannot share subjects' frames.
    """
    _check(sources)
    scenes = sources[0].run.scenes(EXPERIMENT)
    prepared, trials = [], []
    answers: list[list[Answers]] = [[] for _ in sources]
    for source in sources:
        prepared.append(ready(source, image=config.image))
    for subject in range(config.subjects):
        states, trial = states_of(config, subject, scenes)
        made = render(states, rig=scenes.rig, camera=scenes.camera)
        trials.append(trial)
        for kept, source, imager in zip(answers, sources, prepared, strict=True):
            seen = through(source, made, imager, seed=NOISE + subject, snr_db=config.snr_db)
            kept.append(assess.predict(network(source.run.trainer), source.architecture, seen, source.settings.inner))
        if subject + 1 < config.subjects:
            yield subject + 1, []
    whole = joined(trials)
    labels = names or [f"run {i + 1}" for i in range(len(sources))]
    yield (
        config.subjects,
        [
            _result(label, source, kept, whole, config)
            for label, source, kept in zip(labels, sources, answers, strict=True)
        ],
    )


def joined(trials: Sequence[Trial]) -> Trial:
    """Frames of several subjects, one after the other."""
    return Trial(*(np.concatenate([getattr(t, f) for t in trials]) for f in Trial.__slots__))


def _check(sources: Sequence[Source]) -> None:
    if not sources:
        raise ConfigError("no run to evaluate; give one run folder or more")
    views = [(s.settings.scenes.pixels, s.settings.scenes.margin, s.settings.optics.sample_um,
              s.settings.optics.sensor_distance_mm) for s in sources]  # fmt: skip
    if len(set(views)) > 1:
        raise ConfigError(
            f"the runs see frames of different (pixels, margin, sample_um, sensor_distance_mm): {views}; "
            "compare runs of one geometry"
        )


def ready(source: Source, *, image: Literal["true", "trained"] = "true") -> UniformImager | Imager:
    """The imager of a run's lens; its network set to statistics of training frames, as they were formed.

    Raises:
        SceneError: the true image of this lens cannot be formed at the run's ``optics.image_tolerance``.
    """
    trainer = source.run.trainer
    measured = assess.frames(trainer, trainer.scenes, min(8, source.settings.test_batches))
    recalibrate(network(trainer), source.architecture, assess.parts(measured))
    settings, scenes = trainer.optics, source.settings.scenes
    seen = replace(settings, image="true") if image == "true" else settings
    size = scenes.pixels + 2 * scenes.margin
    return formed.imager(seen, trainer.model.coefficients_rad, size, margin=scenes.margin)


def _result(name: str, source: Source, kept: list[Answers], trial: Trial, config: ExperimentConfig) -> Result:
    slip, centre, iou = (
        torch.cat([getattr(a, f) for a in kept]).double().numpy() for f in ("slip_mm", "centre", "iou")
    )
    pupil_mm, rig = centre * source.run.window_um * 1e-3, source.run.scenes(EXPERIMENT).rig
    predicted, judged = calibrated(pupil_mm, slip, trial, config, rig=rig)
    told, _ = calibrated(pupil_mm, trial.slip_mm, trial, config, rig=rig)
    error, told_error = (np.where(judged, angle_deg(p, trial.stimulus_deg), math.nan) for p in (predicted, told))
    mmacs, reach = float(source.row["mmacs"]), source.settings.scenes.slip_mm
    return Result(name, mmacs, trial, slip, centre, iou, error, predicted, told_error, reach)


def calibrated(
    pupil_mm: Array, slip_mm: Array, trial: Trial, config: ExperimentConfig, *, rig: Rig
) -> tuple[Array, Array]:
    """(n, 2) gaze of every frame by its subject's own calibration, and (n,) frames that it never saw."""
    people = taught(pupil_mm, slip_mm, trial, config, rig=rig)
    return answered(people, pupil_mm, slip_mm, trial), ~np.isin(np.arange(len(pupil_mm)), calibrating(trial, config))


def taught(
    pupil_mm: Array, slip_mm: Array, trial: Trial, config: ExperimentConfig, *, rig: Rig
) -> dict[int, PersonalGaze]:
    """Every subject's calibration by number, fitted to the stimuli of :func:`calibrating`."""
    known, people = calibrating(trial, config), {}
    for subject in np.unique(trial.subject):
        rows = known[trial.subject[known] == subject]
        people[int(subject)] = personal.fit(
            pupil_mm[rows], slip_mm[rows], trial.stimulus_deg[rows], rig=rig, hidden=config.hidden, seed=config.seed
        )
    return people


def answered(people: dict[int, PersonalGaze], pupil_mm: Array, slip_mm: Array, trial: Trial) -> Array:
    """(n, 2) gaze of frames, each by its subject's calibration."""
    predicted = np.empty((len(pupil_mm), 2))
    for subject in np.unique(trial.subject):
        rows = np.flatnonzero(trial.subject == subject)
        predicted[rows] = people[int(subject)](pupil_mm[rows], slip_mm[rows])
    return predicted


def calibrating(trial: Trial, config: ExperimentConfig) -> Array:
    """Numbers of the frames that subjects are calibrated on: a share of their stimuli, in every slippage state."""
    known = []
    for subject in np.unique(trial.subject):
        rows = np.flatnonzero(trial.subject == subject)
        points = np.unique(trial.stimulus[rows])
        rng = np.random.default_rng([config.seed, int(subject), POINTS])
        count = round(config.share * len(points))
        if config.points == "spread":
            chosen = spread(config.stimuli_deg[points], count, first=int(rng.integers(len(points))))
        else:
            chosen = rng.choice(len(points), count, replace=False)
        known.append(rows[np.isin(trial.stimulus[rows], points[chosen])])
    return np.concatenate(known)


def spread(places: Array, count: int, *, first: int) -> Array:
    """(count,) numbers of places (n, 2) that cover them: each next one is the farthest from all before it."""
    chosen = [first]
    while len(chosen) < count:
        gaps = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(1)
        chosen.append(int(gaps.argmax()))
    return np.array(chosen)
