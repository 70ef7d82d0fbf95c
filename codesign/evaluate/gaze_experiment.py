"""The experiment of the paper's Sec. 5 with synthetic subjects: a grid of stimuli under
known slippage of the camera.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from codesign.adapt import FinishedRun
from codesign.batches import EXPERIMENT, EyeScenes, as_batch
from codesign.eye import (
    POPULATION,
    CameraRig,
    EyeStates,
    RenderedFrames,
    drawn_of_people,
    render_dressed,
)
from codesign.eye import population as eye
from codesign.gaze import (
    CalibratedPerson,
    NetworkReadings,
    PersonCalibrator,
    SphereCalibrator,
    angle_deg,
    face_angles,
    shared,
)
from codesign.optics import formed
from codesign.settings import ExperimentConfig
from codesign.train import Predictions, SensorFrames, assess
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, PropagationError, SceneError
from metalens.image import Imager, Sensor, low_snr

AXIAL, LATERAL = "axial", "lateral"
# streams of the random generator
LOOKS, POINTS, WORN, PEOPLE, NOISE = 20, 21, 22, 555, 1_000_003
TURNS = (
    4  # corrections of where an eye looks, each twenty times as fine as the one before
)
BEFORE, EACH = (
    100_000,
    120,
)  # first number of the people who calibrated before, and their frames


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
    above: why the error
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
    how: PersonCalibrator | None = None
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
    def slip_rest_mm(self) -> Array:
        """(n, 3) absolute errors beside the mean error of the subject's calibration,
        nan for frames that calibrated.

        What is constant of a person (size of the face, and the camera's turn on it) is
        no slippage: a device is zeroed
        where its wearer calibrates.
        """
        error = self.slip_mm - self.trial.slip_mm
        judged = np.isfinite(self.gaze_deg)
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


def states_of(
    config: ExperimentConfig, subject: int, scenes: EyeScenes
) -> tuple[EyeStates, ExperimentTrials]:
    """All frames of one subject: slippage states outermost, stimuli within.

    Args:
        config: subjects, stimuli, slippage and calibration. scenes: frames by number.

    Raises:
        ConfigError: slippage that takes the eye to the lens.
    """
    stimuli, slips = config.stimuli_deg, config.slips_mm
    nearest = 1e-3 * scenes.rig.distance_um + slips[:, 2].min()
    if not nearest > 0:
        raise ConfigError(
            f"axial_mm {config.axial_mm}: the eye stands {1e-3 * scenes.rig.distance_um:g} mm before the lens; "
            "let it slip less towards it"
        )
    n = len(stimuli) * len(slips)
    rng = np.random.default_rng([config.seed, subject, LOOKS])
    person = eye.draw_states(
        1,
        (config.seed, PEOPLE, subject),
        motion=replace(scenes.settings.motion, scale=0.0),
    )
    base = person[torch.zeros(n, dtype=torch.int64)]
    state, stimulus = (
        g.ravel()
        for g in np.meshgrid(
            np.arange(len(slips)), np.arange(len(stimuli)), indexing="ij"
        )
    )
    looks = stimuli[stimulus] + config.fixation_deg * rng.standard_normal((n, 2))
    traits = base.traits.clone()
    radius = list(POPULATION).index("pupil_radius_um")
    traits[:, radius] *= torch.from_numpy(
        np.clip(1 + config.pupil_sd * rng.standard_normal(n), 0.7, 1.3)
    )
    states = replace(
        base,
        traits=traits,
        torsion_rad=torch.zeros(n, dtype=torch.float64),
        slip_um=torch.from_numpy(slips[state] * 1e3),
        aperture=torch.from_numpy(
            np.clip(1 + 0.05 * rng.standard_normal(n), 0.8, 1.15)
        ),
    )
    trial = ExperimentTrials(
        np.full(n, subject), stimulus, state, stimuli[stimulus], slips[state]
    )
    return turned_to(states, looks, scenes.rig), trial


def render_subject(
    states: EyeStates, config: ExperimentConfig, subject: int, scenes: EyeScenes
) -> RenderedFrames:
    """Frames of one subject with the variety of training, worn by a person: spectacles
    and make-up stay on from frame to frame, before the stage's own camera.

    Args:
        states: subjects with gaze and slippage.
        config: subjects, stimuli, slippage and calibration. scenes: frames by number.
    """
    seed = (config.seed, subject, WORN)
    worn = drawn_of_people(
        np.zeros(len(states), np.int64), scenes.settings.variety, seed
    )
    return render_dressed(states, worn, rig=scenes.rig, camera=scenes.camera)


def turned_to(states: EyeStates, looks_deg: Array, rig: CameraRig) -> EyeStates:
    """States whose visual axes point along angles (n, 2) across and down, in the frame
    of the face: to 1e-5 degrees.

    The visual axis lies nasal of and above the optic axis, by which eyes are turned;
    what that leaves is corrected.

    Args:
        states: subjects with gaze and slippage.
        looks_deg: (n, 2) wanted gaze across and down. rig: pose of camera and lamps.
    """
    kappa = torch.stack([states.trait("kappa_x_rad"), states.trait("kappa_y_rad")], 1)
    straight = torch.zeros_like(states.mount_rad)
    found = replace(
        states,
        gaze_rad=torch.from_numpy(np.radians(looks_deg)) + kappa,
        mount_rad=straight,
    )
    for _ in range(TURNS):
        miss = looks_deg - face_angles(
            eye.eye_axes(found, rig)[1].numpy(), rig.elevation_rad
        )
        found = replace(
            found, gaze_rad=found.gaze_rad + torch.from_numpy(np.radians(miss))
        )
    return replace(found, mount_rad=states.mount_rad)


def image_frames(
    source: FinishedRun,
    made: RenderedFrames,
    prepared: Imager,
    *,
    seed: int,
    sensor: Sensor | None = None,
    quiet: bool = False,
) -> SensorFrames:
    """Rendered frames through a run's lens and sensor, with noise of a seed or
    ``quiet``.

    Args:
        sensor: of :func:`experiment_sensors`; the run's own without it.
        source: finished run: its network, lens and sensor. made: rendered frames.
        prepared: what forms the images.
    """
    margin = source.settings.scenes.margin
    return assess.read_batch(
        source.run.trainer,
        as_batch(made, margin),
        prepared,
        seed=seed,
        sensor=sensor,
        quiet=quiet,
    )


def experiment_sensors(
    sources: Sequence[FinishedRun], config: ExperimentConfig
) -> list[Sensor]:
    """Every run's sensor in the light of the experiment.

    Dim light is one exposure and one background for all runs: those at which a pixel of
    the first run has ``config.snr_db`` behind a lens of its aperture that images all
    light. What a lens loses, and a smaller aperture, costs it signal.

    Args:
        sources: runs to compare.
    """
    sensors = [source.run.trainer.sensor for source in sources]
    if config.snr_db is None:
        return sensors
    scenes = sources[0].run.scenes(EXPERIMENT)
    states, _ = states_of(config, 0, scenes)
    at_origin = states[slice(len(config.stimuli_deg))]
    frames = render_subject(at_origin, config, 0, scenes)
    pitch_um = float(sources[0].run.trainer.model.pitch_um.detach())
    dim = low_snr(
        replace(sensors[0], pitch_um=pitch_um),
        float(frames.pinhole().mean()),
        snr_db=config.snr_db,
    )
    areas = [source.settings.optics.aperture_mm**2 for source in sources]
    found = []
    for sensor, area in zip(sensors, areas, strict=True):
        base = (sensor.base_pitch_um / dim.base_pitch_um) ** 2  # counts of a base pixel
        scale = base * area / areas[0]
        found.append(
            replace(
                sensor,
                exposure_e=dim.exposure_e * scale,
                ambient_e=dim.ambient_e * scale,
            )
        )
    return found


@torch.no_grad()
def run_experiment(
    sources: Sequence[FinishedRun],
    config: ExperimentConfig,
    *,
    names: Sequence[str] | None = None,
) -> Iterator[tuple[int, list[RunResult]]]:
    """Run the experiment, subject by subject.

    Args:
        sources: runs to compare. config: subjects, stimuli, slippage and calibration.
        names: of the runs; numbered without it.

    Yields:
        (subjects done, one :class:`Result` a run); results are there with the last
        subject only.

    Raises:
        ConfigError: runs whose frames differ in size, samples or lens distance: they
            cannot share subjects' frames; or
            eyes that slip to where a run's images hold no depth.
    """
    _check(sources, config)
    scenes = sources[0].run.scenes(EXPERIMENT)
    trials: list[ExperimentTrials] = []
    answers: list[list[Predictions]] = [[] for _ in sources]
    on_fine: list[list[Predictions]] = [[] for _ in sources]
    prepared = [prepare_run(source, image=config.image) for source in sources]
    fine = [finer_imager(source) for source in sources]
    sensors = experiment_sensors(sources, config)
    how = [
        run_calibrator(source, imager, config, sensor)
        for source, imager, sensor in zip(sources, prepared, sensors, strict=True)
    ]
    for subject in range(config.subjects):
        states, trial = states_of(config, subject, scenes)
        made = render_subject(states, config, subject, scenes)
        trials.append(trial)
        each = [
            *zip(answers, sources, prepared, sensors, strict=True),
            *zip(on_fine, sources, fine, sensors, strict=True),
        ]
        for kept, source, imager, sensor in each:
            if imager is None:
                continue
            seen = image_frames(
                source, made, imager, seed=NOISE + subject, sensor=sensor
            )
            kept.append(_answers(source, seen))
        if subject + 1 < config.subjects:
            yield subject + 1, []
    whole = join_subjects(trials)
    labels = names or [f"run {i + 1}" for i in range(len(sources))]
    above = [
        formed.image_tolerance_problem(source.run.trainer.optics, one)
        for source, one in zip(sources, prepared, strict=True)
    ]
    results = []
    for i, (label, source, one) in enumerate(zip(labels, sources, how, strict=True)):
        found = _result(label, source, answers[i], whole, config, one)
        exact = (
            _result(label, source, on_fine[i], whole, config, one)
            if on_fine[i]
            else None
        )
        results.append(replace(found, above=above[i], finer=exact))
    yield config.subjects, results


def _answers(source: FinishedRun, seen: SensorFrames) -> Predictions:
    return assess.predict_frames(
        source.run.trainer.model.net, source.architecture, seen, source.settings.inner
    )


def join_subjects(trials: Sequence[ExperimentTrials]) -> ExperimentTrials:
    """Frames of several subjects, one after the other.

    Args:
        trials: one record a subject.
    """
    return ExperimentTrials(
        *(
            np.concatenate([getattr(t, f) for t in trials])
            for f in ExperimentTrials.__slots__
        )
    )


def rows_of_trial(trial: ExperimentTrials, rows: Array) -> ExperimentTrials:
    """Some of the frames; ``rows``: their numbers.

    Args:
        trial: subject, stimulus and slippage of every frame.
    """
    parts = (getattr(trial, name)[rows] for name in ExperimentTrials.__slots__)
    return ExperimentTrials(*parts)


def _check(sources: Sequence[FinishedRun], config: ExperimentConfig) -> None:
    if not sources:
        raise ConfigError("no run to evaluate; give one run folder or more")
    views = [(s.settings.scenes.pixels, s.settings.scenes.margin, s.settings.optics.sample_um,
              s.settings.optics.sensor_distance_mm) for s in sources]  # fmt: skip
    if len(set(views)) > 1:
        raise ConfigError(
            f"the runs see frames of different (pixels, margin, sample_um, sensor_distance_mm): {views}; "
            "compare runs of one geometry"
        )
    slips = config.slips_mm[:, 2]
    for source in sources:
        eye_mm = 1e-3 * source.run.scenes(EXPERIMENT).rig.distance_um
        held = source.settings.optics.depths_mm
        if not held[0] <= eye_mm + slips.min() <= eye_mm + slips.max() <= held[1]:
            raise ConfigError(
                f"axial_mm {config.axial_mm}: eyes {eye_mm + slips.min():g} to {eye_mm + slips.max():g} mm before the "
                f"lens, where the run's images hold optics.depths_mm = {held}: let them slip less, or train on more"
            )


def prepare_run(
    source: FinishedRun, *, image: Literal["true", "trained"] = "true"
) -> Imager:
    """The imager of a run's lens, of a retraining the made one; its network set to
    statistics of training frames, as
    they were formed.

    Args:
        source: finished run: its network, lens and sensor.

    Raises:
        SceneError: the true image of this lens cannot be formed at the run's
            ``optics.image_tolerance``.
    """
    trainer = source.run.trainer
    assess.recalibrate_network(trainer, source.architecture)
    settings, scenes = trainer.optics, source.settings.scenes
    seen = replace(settings, image="true") if image == "true" else settings
    size = scenes.pixels + 2 * scenes.margin
    return formed.make_imager(
        seen,
        trainer.model.coefficients_rad,
        size,
        margin=scenes.margin,
        made=source.made,
    )


def finer_imager(source: FinishedRun) -> Imager | None:
    """The true image of a run's lens at a quarter of the run's tolerance; None where it
    cannot be formed so precisely, or the run was trained on a uniform image.

    Args:
        source: finished run: its network, lens and sensor.
    """
    settings = assess.finer_image(source.run.trainer.optics)
    if settings is None:
        return None
    scenes = source.settings.scenes
    try:
        return formed.make_imager(
            settings,
            source.run.trainer.model.coefficients_rad,
            scenes.pixels + 2 * scenes.margin,
            margin=scenes.margin,
            made=source.made,
        )
    except (SceneError, PropagationError):
        return None


def sphere_calibrator(
    source: FinishedRun, config: ExperimentConfig
) -> SphereCalibrator:
    """Calibrates before a run's camera by pupil and slippage alone.

    Args:
        source: finished run: its network, lens and sensor.
        config: subjects, stimuli, slippage and calibration.
    """
    return SphereCalibrator(
        source.run.scenes(EXPERIMENT).rig, config.hidden, config.seed
    )


@torch.no_grad()
def run_calibrator(
    source: FinishedRun, imager: Imager, config: ExperimentConfig, sensor: Sensor
) -> PersonCalibrator:
    """Calibrator of gaze for a run: mixed-effects model where the network reads the
    optic axis, else sphere and regressor.

    That is learned from ``config.people`` whom neither training nor the experiment
    shows, before the same stimuli, on
    the same stage at places of their own between its ends: EACH of their frames, drawn
    at random, through the run's
    lens, light and noise.

    Args:
        source: finished run: its network, lens and sensor.
        imager: what forms the images. sensor: with its exposure.
    """
    scenes = source.run.scenes(EXPERIMENT)
    found, looked = [], []
    for person in range(config.people):
        rng = np.random.default_rng([config.seed, BEFORE + person, POINTS])
        axial, lateral = (
            rng.uniform(min((0.0, *ends)), max((0.0, *ends)), len(ends))
            for ends in (config.axial_mm, config.lateral_mm)
        )
        theirs = replace(config, axial_mm=tuple(axial), lateral_mm=tuple(lateral))
        states, trial = states_of(theirs, BEFORE + person, scenes)
        rows = np.sort(rng.permutation(len(trial.subject))[:EACH])
        some = states[torch.from_numpy(rows)]
        made = render_subject(some, theirs, BEFORE + person, scenes)
        seen = image_frames(
            source, made, imager, seed=2 * NOISE + person, sensor=sensor
        )
        found.append(_answers(source, seen))
        looked.append(trial.stimulus_deg[rows])
        if found[0].axis is None:
            return sphere_calibrator(source, config)
    who = np.repeat(np.arange(config.people), [len(one) for one in looked])
    return shared.learn_population(
        read_from(found, source), np.concatenate(looked), who
    )


def read_from(kept: Sequence[Predictions], source: FinishedRun) -> NetworkReadings:
    """A run's answers to frames one after the other, in the units that gaze is
    calibrated in.

    Args:
        kept: one record a subject. source: finished run: its network, lens and sensor.
    """
    centre, slip = (
        torch.cat([getattr(a, f) for a in kept]).double().numpy()
        for f in ("centre", "slip_mm")
    )
    axes = [a.axis for a in kept if a.axis is not None]
    tilt = source.run.scenes(EXPERIMENT).rig.elevation_rad
    angles = face_angles(torch.cat(axes).double().numpy(), tilt) if axes else None
    return NetworkReadings(centre * source.run.window_um * 1e-3, slip, angles)


def _result(
    name: str,
    source: FinishedRun,
    kept: list[Predictions],
    trial: ExperimentTrials,
    config: ExperimentConfig,
    how: PersonCalibrator,
) -> RunResult:
    read = read_from(kept, source)
    predicted, judged = calibrated_gaze(read, trial, config, how)
    exact, _ = calibrated_gaze(
        replace(read, slip_mm=trial.slip_mm),
        trial,
        config,
        sphere_calibrator(source, config),
    )
    error, told_error = (
        np.where(judged, angle_deg(p, trial.stimulus_deg), math.nan)
        for p in (predicted, exact)
    )
    mmacs = float(source.row["mmacs"])
    reach = source.settings.scenes.slip_mm
    centre, iou = (
        torch.cat([getattr(a, f) for a in kept]).double().numpy()
        for f in ("centre", "iou")
    )
    return RunResult(
        name,
        mmacs,
        trial,
        read.slip_mm,
        centre,
        iou,
        error,
        predicted,
        told_error,
        reach,
        how,
    )


def calibrated_gaze(
    read: NetworkReadings,
    trial: ExperimentTrials,
    config: ExperimentConfig,
    how: PersonCalibrator,
) -> tuple[Array, Array]:
    """(n, 2) gaze of every frame by its subject's own calibration, and (n,) frames that
    it never saw.

    Args:
        read: pupil, slippage and axis as a network reads them.
        trial: subject, stimulus and slippage of every frame.
        config: subjects, stimuli, slippage and calibration.
        how: way to calibrate a person.
    """
    judged = ~np.isin(np.arange(len(read)), calibration_frames(trial, config))
    return predicted_gaze(
        calibrate_subjects(read, trial, config, how), read, trial
    ), judged


def calibrate_subjects(
    read: NetworkReadings,
    trial: ExperimentTrials,
    config: ExperimentConfig,
    how: PersonCalibrator,
) -> dict[int, CalibratedPerson]:
    """Every subject's calibration by number, on the stimuli of
    :func:`calibration_frames`.

    Args:
        read: pupil, slippage and axis as a network reads them.
        trial: subject, stimulus and slippage of every frame.
        config: subjects, stimuli, slippage and calibration.
        how: way to calibrate a person.
    """
    known = calibration_frames(trial, config)
    mine = {int(s): known[trial.subject[known] == s] for s in np.unique(trial.subject)}
    return {
        s: how.person(read[rows], trial.stimulus_deg[rows]) for s, rows in mine.items()
    }


def predicted_gaze(
    people: Mapping[int, CalibratedPerson],
    read: NetworkReadings,
    trial: ExperimentTrials,
) -> Array:
    """(n, 2) gaze of frames, each by its subject's calibration.

    Args:
        people: calibrated persons by number of the subject.
        read: pupil, slippage and axis as a network reads them.
        trial: subject, stimulus and slippage of every frame.
    """
    predicted = np.empty((len(read), 2))
    for subject in np.unique(trial.subject):
        rows = np.flatnonzero(trial.subject == subject)
        predicted[rows] = people[int(subject)](read[rows])
    return predicted


def calibration_frames(trial: ExperimentTrials, config: ExperimentConfig) -> Array:
    """Numbers of the frames that subjects are calibrated on: a share of their stimuli,
    in every slippage state.

    Args:
        trial: subject, stimulus and slippage of every frame.
        config: subjects, stimuli, slippage and calibration.
    """
    known = []
    for subject in np.unique(trial.subject):
        rows = np.flatnonzero(trial.subject == subject)
        points = np.unique(trial.stimulus[rows])
        rng = np.random.default_rng([config.seed, int(subject), POINTS])
        count = round(config.share * len(points))
        if config.points == "spread":
            chosen = farthest_points(
                config.stimuli_deg[points], count, first=int(rng.integers(len(points)))
            )
        else:
            chosen = rng.choice(len(points), count, replace=False)
        known.append(rows[np.isin(trial.stimulus[rows], points[chosen])])
    return np.concatenate(known)


def farthest_points(places: Array, count: int, *, first: int) -> Array:
    """(count,) numbers of places (n, 2) that cover them: each next one is the farthest
    from all before it.

    Args:
        first: number of the first place.
    """
    chosen = [first]
    while len(chosen) < count:
        gaps = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(1)
        chosen.append(int(gaps.argmax()))
    return np.array(chosen)
