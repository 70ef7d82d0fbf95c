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
from codesign.optics import OpticsConfig, image_formation
from codesign.settings import ExperimentConfig
from codesign.train import FramePredictions, SensorFrames, assess
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, PropagationError, SceneError
from metalens.core.report import figure_png, make_figure
from metalens.image import Imager, Sensor, low_snr

AXIAL, LATERAL = "axial", "lateral"
# streams of the random generator
LOOKS, POINTS, WORN, PEOPLE, NOISE = 20, 21, 22, 555, 1_000_003
BEFORE, EACH = 100_000, 120  # people who calibrated before: first number, frames each


@dataclass(frozen=True, eq=False, slots=True)
class ExperimentTrials:
    """Subject, stimulus and slippage state of every frame, with their true values.

    subject, stimulus, state: (n,) numbers. stimulus_deg: (n, 2) direction across and
    down. slip_mm: (n, 3) slippage along x, y and z.
    """

    subject: Array
    stimulus: Array
    state: Array
    stimulus_deg: Array
    slip_mm: Array

    def __getitem__(self, rows: Array) -> "ExperimentTrials":
        return eye.select_rows(self, rows)

    def group(self, kind: str) -> Array:
        """(n,) True for frames of the axial or lateral states; both hold the origin.

        Args:
            kind: "axial" or "lateral".
        """
        other = self.slip_mm[:, [0, 1] if kind == AXIAL else [1, 2]]
        return np.asarray((other == 0).all(1))


@dataclass(frozen=True, eq=False, slots=True)
class RunResult:
    """Readings and gaze errors of one run in the experiment.

    slip_mm: (n, 3) slippage read by the network.
    centre: (n, 2) pupil read, fraction of the image. iou: (n,) overlap of the mask.
    gaze_deg: (n,) error of the calibrated gaze, nan for calibration frames.
    sphere_gaze_deg: the same by the spherical-eye solver with a residual regressor.
    how: calibrator of the subjects.
    above: why the error of the images exceeds the run's tolerance; empty otherwise.
    finer: result on images formed at a quarter of the tolerance, with a calibration of
    its own; None where they cannot be formed.
    """

    name: str
    mmacs: float
    trial: ExperimentTrials
    slip_mm: Array
    centre: Array
    iou: Array
    gaze_deg: Array
    sphere_gaze_deg: Array
    how: PersonCalibrator | None = None
    above: str = ""
    finer: "RunResult | None" = None

    def gaze(self, kind: str) -> float:
        """Mean gaze error over the judged frames of a group, deg.

        Args:
            kind: "axial" or "lateral".
        """
        return float(np.nanmean(self.gaze_deg[self.trial.group(kind)]))

    @property
    def subject_errors(self) -> dict[str, Array]:
        """(subjects,) mean of every error by name, gaze in deg and slippage in mm."""
        slip = np.abs(self.slip_mm - self.trial.slip_mm)
        axial, lateral = self.trial.group(AXIAL), self.trial.group(LATERAL)
        errors = {
            "gaze_axial_deg": np.where(axial, self.gaze_deg, math.nan),
            "gaze_lateral_deg": np.where(lateral, self.gaze_deg, math.nan),
            "sphere_gaze_axial_deg": np.where(axial, self.sphere_gaze_deg, math.nan),
            "sphere_gaze_lateral_deg": np.where(
                lateral, self.sphere_gaze_deg, math.nan
            ),
            "slip_mm": slip.mean(1),
            "slip_axial_mm": slip[:, 2],
            "slip_lateral_mm": slip[:, :2].mean(1),
            "iou": self.iou,
        }
        of_subject = [self.trial.subject == s for s in np.unique(self.trial.subject)]
        return {
            name: np.array([np.nanmean(values[rows]) for rows in of_subject])
            for name, values in errors.items()
        }


def draw_trials(
    config: ExperimentConfig, subject: int, scenes: EyeScenes
) -> tuple[EyeStates, ExperimentTrials]:
    """Eye states and true values of all frames of one subject, slippage state by state,
    every stimulus in each.

    Args:
        config: subjects, stimuli, slippage and calibration.
        subject: number of the subject, part of every seed.
        scenes: rig and variety of the scenes.

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
    state, stimulus = np.divmod(np.arange(n), len(stimuli))
    gaze_deg = stimuli[stimulus] + config.fixation_deg * rng.standard_normal((n, 2))
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
    return turn_eyes(states, gaze_deg, scenes.rig), trial


def render_subject(
    states: EyeStates, config: ExperimentConfig, subject: int, scenes: EyeScenes
) -> RenderedFrames:
    """Rendered frames of one subject, with spectacles and make-up that are the same in
    all of them.

    Args:
        states: (n,) eye states with gaze and slippage.
        config: subjects, stimuli, slippage and calibration.
        subject: number of the subject, part of the seed.
        scenes: rig, camera and variety of the scenes.
    """
    seed = (config.seed, subject, WORN)
    worn = drawn_of_people(
        np.zeros(len(states), np.int64), scenes.settings.variety, seed
    )
    return render_dressed(states, worn, rig=scenes.rig, camera=scenes.camera)


def turn_eyes(states: EyeStates, looks_deg: Array, rig: CameraRig) -> EyeStates:
    """Eye states turned until their visual axes point in given directions, to 1e-5
    degrees.

    Eyes are turned by their optic axis, and the visual axis lies at the angle kappa to
    it. A first turn adds kappa; fixed-point steps remove the remaining error.

    Args:
        states: (n,) eye states.
        looks_deg: (n, 2) gaze across and down in the frame of the face.
        rig: pose of camera and lamps.
    """
    across = rig.temple * states.trait("kappa_x_rad")
    kappa = torch.stack([across, states.trait("kappa_y_rad")], 1)
    unmounted = torch.zeros_like(states.mount_rad)
    turned = replace(
        states,
        gaze_rad=torch.from_numpy(np.radians(looks_deg)) + kappa,
        mount_rad=unmounted,
    )
    for _ in range(4):  # each leaves a twentieth of the error
        error_deg = looks_deg - face_angles(eye.eye_axes(turned, rig)[1].numpy(), rig)
        turned = replace(
            turned, gaze_rad=turned.gaze_rad + torch.from_numpy(np.radians(error_deg))
        )
    return replace(turned, mount_rad=states.mount_rad)


def predict_rendered(
    source: FinishedRun,
    rendered: RenderedFrames,
    imager: Imager,
    *,
    seed: int,
    sensor: Sensor,
    quiet: bool = False,
) -> FramePredictions:
    """Pupil, slippage and axis that a run's network predicts from rendered scenes
    through its lens.

    Args:
        source: finished run: its network, lens and sensor.
        rendered: rendered frames.
        imager: imager of the run's lens.
        seed: seed of the noise.
        sensor: sensor of :func:`experiment_sensors`.
        quiet: no noise.
    """
    batch = as_batch(rendered, source.settings.scenes.margin)
    return predict_with_run(
        source,
        assess.read_batch(
            source.run.trainer, batch, imager, seed=seed, sensor=sensor, quiet=quiet
        ),
    )


def predict_with_run(source: FinishedRun, frames: SensorFrames) -> FramePredictions:
    """Pupil, slippage and axis that a run's network predicts from sensor frames.

    Args:
        source: finished run: its network, lens and sensor.
        frames: of the sensor.
    """
    return assess.predict_frames(
        source.run.trainer.model.net, source.architecture, frames, source.settings.inner
    )


def experiment_sensors(
    sources: Sequence[FinishedRun], config: ExperimentConfig
) -> list[Sensor]:
    """Sensor of every run at the exposure and background of the experiment.

    Dim light: exposure and background at which a pixel of the first run has
    ``config.snr_db`` behind a lossless lens of its aperture. They scale with the area
    of a run's aperture and of its base pixel.

    Args:
        sources: runs to compare.
        config: states the signal-to-noise ratio; None leaves the sensors as they are.
    """
    sensors = [source.run.trainer.sensor for source in sources]
    if config.snr_db is None:
        return sensors
    scenes = sources[0].run.scenes(EXPERIMENT)
    states, _ = draw_trials(config, 0, scenes)
    at_origin = states[slice(len(config.stimuli_deg))]
    frames = render_subject(at_origin, config, 0, scenes)
    pitch_um = float(sources[0].run.trainer.model.pitch_um.detach())
    dim = low_snr(
        replace(sensors[0], pitch_um=pitch_um),
        float(frames.pinhole().mean()),
        snr_db=config.snr_db,
    )
    # electrons of a base pixel behind the aperture
    collected = [
        (sensor.base_pitch_um * source.settings.optics.aperture_mm) ** 2
        for sensor, source in zip(sensors, sources, strict=True)
    ]
    return [
        replace(
            sensor,
            exposure_e=dim.exposure_e * share / collected[0],
            ambient_e=dim.ambient_e * share / collected[0],
        )
        for sensor, share in zip(sensors, collected, strict=True)
    ]


@torch.no_grad()
def run_experiment(
    sources: Sequence[FinishedRun],
    config: ExperimentConfig,
    *,
    names: Sequence[str] | None = None,
) -> Iterator[tuple[int, list[RunResult]]]:
    """Gaze and slippage errors of runs on the same synthetic subjects.

    Every subject is rendered once. Each run images, reads and calibrates on those
    frames, and once more on its finer images where they can be formed.

    Args:
        sources: runs to compare.
        config: subjects, stimuli, slippage and calibration.
        names: names of the runs; numbered without them.

    Yields:
        (subjects done, results): one :class:`RunResult` a run after the last subject,
        an empty list before.

    Raises:
        ConfigError: runs whose frames differ in size, samples or lens distance, so that
            they cannot share frames; slippage out of the depths of a run's images.
    """
    _check_sources(sources, config)
    scenes = sources[0].run.scenes(EXPERIMENT)
    trials: list[ExperimentTrials] = []
    sensors = experiment_sensors(sources, config)
    devices = []
    for source, sensor in zip(sources, sensors, strict=True):
        imager = prepare_run(source, image=config.image)
        calibrator = run_calibrator(source, imager, config, sensor)
        images = [image for image in (imager, finer_imager(source)) if image]
        devices.append((source, sensor, calibrator, images))
    # of every run, image and subject
    predictions: list[list[list[FramePredictions]]] = [
        [[] for _ in images] for *_, images in devices
    ]
    for subject in range(config.subjects):
        states, trial = draw_trials(config, subject, scenes)
        rendered = render_subject(states, config, subject, scenes)
        trials.append(trial)
        for (source, sensor, _, images), outputs in zip(
            devices, predictions, strict=True
        ):
            for imager, output in zip(images, outputs, strict=True):
                output.append(
                    predict_rendered(
                        source, rendered, imager, seed=NOISE + subject, sensor=sensor
                    )
                )
        if subject + 1 < config.subjects:
            yield subject + 1, []
    joined = join_subjects(trials)
    results = []
    for number, ((source, _, calibrator, images), outputs) in enumerate(
        zip(devices, predictions, strict=True)
    ):
        name = names[number] if names else f"run {number + 1}"
        result, *finer = (
            _result(name, source, output, joined, config, calibrator)
            for output in outputs
        )
        optics = source.run.trainer.optics
        above = image_formation.image_tolerance_problem(optics, images[0])
        results.append(replace(result, above=above, finer=finer[0] if finer else None))
    yield config.subjects, results


def join_subjects(trials: Sequence[ExperimentTrials]) -> ExperimentTrials:
    """Frames of several subjects, one after the other.

    Args:
        trials: one record a subject.
    """
    return ExperimentTrials(
        *(
            np.concatenate([getattr(trial, name) for trial in trials])
            for name in ExperimentTrials.__slots__
        )
    )


def _check_sources(sources: Sequence[FinishedRun], config: ExperimentConfig) -> None:
    """Refuse runs of different geometry, and slippage out of the depths of a run's
    images.
    """
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
        limits = source.settings.optics.depths_mm
        if not limits[0] <= eye_mm + slips.min() <= eye_mm + slips.max() <= limits[1]:
            raise ConfigError(
                f"axial_mm {config.axial_mm}: eyes {eye_mm + slips.min():g} to {eye_mm + slips.max():g} mm before the "
                f"lens, where the run's images hold optics.depths_mm = {limits}: let them slip less, or train on more"
            )


def prepare_run(
    source: FinishedRun, *, image: Literal["true", "trained"] = "true"
) -> Imager:
    """Imager of a run's lens; of a retraining, of its manufactured lens.

    The batch normalisation of the run's network is set to the statistics of its
    training frames first.

    Args:
        source: finished run: its network, lens and sensor.
        image: "true" image, or the image model of the run's training.

    Raises:
        SceneError: the true image of this lens cannot be formed at the run's
            ``optics.image_tolerance``.
    """
    trainer = source.run.trainer
    assess.recalibrate_network(trainer, source.architecture)
    trained = trainer.optics
    return _imager_of(
        source, trained if image == "trained" else replace(trained, image="true")
    )


def finer_imager(source: FinishedRun) -> Imager | None:
    """Imager of a run's lens at a quarter of the run's tolerance.

    None where the image cannot be formed that precisely, or the run was trained on a
    uniform image.

    Args:
        source: finished run: its network, lens and sensor.
    """
    settings = assess.finer_image(source.run.trainer.optics)
    try:
        return None if settings is None else _imager_of(source, settings)
    except (SceneError, PropagationError):
        return None


def _imager_of(source: FinishedRun, settings: OpticsConfig) -> Imager:
    """Imager of the lens of a run or retraining, formed as the settings say."""
    margin = source.settings.scenes.margin
    return image_formation.make_imager(
        settings,
        source.run.trainer.model.coefficients_rad,
        source.settings.scenes.pixels + 2 * margin,
        margin=margin,
        made=source.made,
    )


@torch.no_grad()
def run_calibrator(
    source: FinishedRun, imager: Imager, config: ExperimentConfig, sensor: Sensor
) -> PersonCalibrator:
    """Calibrator of gaze for a run: the configured one, or sphere and regressor where
    the network predicts no optic axis.

    The mixed-effects model is learned from ``config.people`` further subjects at the same stimuli,
    with slippage drawn uniformly between the ends of the experiment's. ``EACH`` random
    frames of each pass the run's lens, light and noise.

    Args:
        source: finished run: its network, lens and sensor.
        imager: imager of the run's lens.
        config: subjects, stimuli, slippage and calibration.
        sensor: the run's sensor at the exposure of the experiment.
    """
    scenes = source.run.scenes(EXPERIMENT)
    sphere = SphereCalibrator(scenes.rig, config.hidden, config.seed)
    if config.calibrator == "sphere":
        return sphere
    predictions = []
    stimuli_deg = []
    for person in range(config.people):
        rng = np.random.default_rng([config.seed, BEFORE + person, POINTS])
        axial, lateral = (
            rng.uniform(min((0.0, *ends)), max((0.0, *ends)), len(ends))
            for ends in (config.axial_mm, config.lateral_mm)
        )
        person_config = replace(
            config, axial_mm=tuple(axial), lateral_mm=tuple(lateral)
        )
        states, trial = draw_trials(person_config, BEFORE + person, scenes)
        rows = np.sort(rng.permutation(len(trial.subject))[:EACH])
        chosen_states = states[torch.from_numpy(rows)]
        rendered = render_subject(chosen_states, person_config, BEFORE + person, scenes)
        predictions.append(
            predict_rendered(
                source, rendered, imager, seed=2 * NOISE + person, sensor=sensor
            )
        )
        stimuli_deg.append(trial.stimulus_deg[rows])
        if predictions[0].axis is None:
            return sphere
    person_of_frame = np.repeat(np.arange(config.people), list(map(len, stimuli_deg)))
    return shared.learn_population(
        collect_readings(predictions, source),
        np.concatenate(stimuli_deg),
        person_of_frame,
    )


def collect_readings(
    predictions: Sequence[FramePredictions], source: FinishedRun
) -> NetworkReadings:
    """Readings of all frames in the units of the gaze calibration: pupil and slippage
    in mm, optic axis as angles in the frame of the face.

    Args:
        predictions: predictions of every subject, in their order.
        source: finished run: its network, lens and sensor.
    """
    centre, slip_mm = (_joined(predictions, name) for name in ("centre", "slip_mm"))
    angles = None
    if predictions[0].axis is not None:
        rig = source.run.scenes(EXPERIMENT).rig
        angles = face_angles(_joined(predictions, "axis"), rig)
    return NetworkReadings(centre * source.run.window_um * 1e-3, slip_mm, angles)


def _joined(predictions: Sequence[FramePredictions], name: str) -> Array:
    """(n, ...) float64 values of a field of all predictions."""
    values = torch.cat([getattr(prediction, name) for prediction in predictions])
    return np.asarray(values.double().numpy())


def _result(
    name: str,
    source: FinishedRun,
    predictions: list[FramePredictions],
    trial: ExperimentTrials,
    config: ExperimentConfig,
    calibrator: PersonCalibrator,
) -> RunResult:
    """Result of one run from the predictions of all subjects.

    Gaze errors are nan for calibration frames.
    """
    readings = collect_readings(predictions, source)

    def gaze_error_deg(how: PersonCalibrator) -> Array:
        predicted, judged = calibrated_gaze(readings, trial, config, how)
        return np.where(judged, angle_deg(predicted, trial.stimulus_deg), math.nan)

    error_deg = sphere_error_deg = gaze_error_deg(calibrator)
    if not isinstance(calibrator, SphereCalibrator):
        rig = source.run.scenes(EXPERIMENT).rig
        sphere = SphereCalibrator(rig, config.hidden, config.seed)
        sphere_error_deg = gaze_error_deg(sphere)
    return RunResult(
        name,
        float(source.row["mmacs"]),
        trial,
        readings.slip_mm,
        _joined(predictions, "centre"),
        _joined(predictions, "iou"),
        error_deg,
        sphere_error_deg,
        calibrator,
    )


def calibrated_gaze(
    read: NetworkReadings,
    trial: ExperimentTrials,
    config: ExperimentConfig,
    how: PersonCalibrator,
) -> tuple[Array, Array]:
    """(n, 2) gaze of every frame by its subject's own calibration, and (n,) True for
    frames that took no part in it.

    Args:
        read: pupil, slippage and axis as a network reads them.
        trial: subject, stimulus and slippage of every frame.
        config: subjects, stimuli, slippage and calibration.
        how: way to calibrate a person.
    """
    judged = ~np.isin(np.arange(len(read)), calibration_frames(trial, config))
    people = calibrate_subjects(read, trial, config, how)
    return predicted_gaze(people, read, trial), judged


def calibrate_subjects(
    read: NetworkReadings,
    trial: ExperimentTrials,
    config: ExperimentConfig,
    how: PersonCalibrator,
) -> dict[int, CalibratedPerson]:
    """{subject: calibration} on the frames of :func:`calibration_frames`.

    Args:
        read: pupil, slippage and axis as a network reads them.
        trial: subject, stimulus and slippage of every frame.
        config: subjects, stimuli, slippage and calibration.
        how: way to calibrate a person.
    """
    calibration = calibration_frames(trial, config)
    people = {}
    for subject in np.unique(trial.subject):
        rows = calibration[trial.subject[calibration] == subject]
        people[int(subject)] = how.person(read[rows], trial.stimulus_deg[rows])
    return people


def predicted_gaze(
    people: Mapping[int, CalibratedPerson],
    read: NetworkReadings,
    trial: ExperimentTrials,
) -> Array:
    """(n, 2) gaze of frames across and down in degrees, each by its subject's
    calibration.

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
    """Numbers of the calibration frames: a share of every subject's stimuli, drawn at
    random, in all slippage states.

    Args:
        trial: subject, stimulus and slippage of every frame.
        config: subjects, stimuli, slippage and calibration.
    """
    frames = []
    for subject in np.unique(trial.subject):
        rows = np.flatnonzero(trial.subject == subject)
        points = np.unique(trial.stimulus[rows])
        rng = np.random.default_rng([config.seed, int(subject), POINTS])
        count = round(config.share * len(points))
        chosen = rng.choice(len(points), count, replace=False)
        frames.append(rows[np.isin(trial.stimulus[rows], points[chosen])])
    return np.concatenate(frames)


def plot_ambiguity(result: RunResult) -> bytes:
    """Fig. 10: pupil centres of all stimuli under axial and lateral slippage, and their
    means with ranges.

    Args:
        result: of one run.
    """
    trial = result.trial
    percent = result.centre * 100
    figure, axes = make_figure(1, 3, size=(10.5, 3.2))
    for panel, kind, axis in ((axes[0], AXIAL, 2), (axes[1], LATERAL, 0)):
        chosen = trial.group(kind)
        dots = panel.scatter(
            *percent[chosen].T, c=trial.slip_mm[chosen, axis], s=2, cmap="viridis"
        )
        figure.colorbar(dots, ax=panel, label=f"d{'xyz'[axis]} / mm")
        panel.set_title(f"{kind} slippage")
    for state in np.unique(trial.state):
        places = percent[trial.state == state]
        x, _, z = trial.slip_mm[trial.state == state][0]
        middle = places.mean(0)
        span = np.abs(np.percentile(places, [2.5, 97.5], axis=0) - middle)
        axes[2].errorbar(
            *middle,
            xerr=span[:, :1],
            yerr=span[:, 1:],
            fmt="o",
            label=f"({x:g}, {z:g})",
        )
    axes[2].set_title("mean and 95 % range by (dx, dz)")
    axes[2].legend(fontsize=6)
    for panel in axes:
        panel.set(xlabel="pupil x / % of the frame", ylabel="pupil y / %")
        panel.invert_yaxis()
    return figure_png(figure)


def plot_gaze_errors(results: Sequence[RunResult]) -> bytes:
    """Fig. 11: mean gaze error at every stimulus, as the size of its marker, under
    axial and lateral slippage.

    Args:
        results: one a run.
    """
    figure, axes = make_figure(1, 2, size=(10.5, 3.8))
    for panel, kind in zip(axes, (AXIAL, LATERAL), strict=True):
        for number, result in enumerate(results):
            trial, colour = result.trial, f"C{number}"
            shift = (number - (len(results) - 1) / 2) * 1.1
            chosen = trial.group(kind) & np.isfinite(result.gaze_deg)
            for point in np.unique(trial.stimulus[chosen]):
                at_point = chosen & (trial.stimulus == point)
                x, y = trial.stimulus_deg[at_point][0]
                area = 24 * result.gaze_deg[at_point].mean() ** 2 + 2
                panel.scatter(x + shift, y, s=area, color=colour, alpha=0.75, lw=0)
            label = f"{result.name}: {result.gaze(kind):.2f}°"
            panel.scatter([], [], color=colour, label=label)
        panel.set(
            title=f"{kind} slippage",
            xlabel="stimulus across / deg",
            ylabel="stimulus down / deg",
            aspect="equal",
        )
        panel.invert_yaxis()
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), fontsize=7)
    return figure_png(figure)
