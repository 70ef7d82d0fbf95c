"""A trained reader before the frames of the virtual experiment: what every cause adds
on the way to the answered gaze.

    true pupil and slippage -> the person's calibration          subject and calibration
    where the person really looks                                fixation
    pupil, then slippage and axis read from noiseless frames     reader, pupil and slippage
    noise of the sensor                                          sensor noise
    what training left out of its image                          field, radiometry, spectrum

Each state has the causes of the one before and one more; persons are calibrated in
every state anew, as they would be
on such a device. A cause adds what the mean error has more than in the state before, in
quadrature. The last state is
the virtual experiment itself. Changes of the optics behind it (:meth:`Reading.changed`)
add the mean angle by which
they turn the answers: independent of the rest, that adds in quadrature too. What a
reader was trained with is no error
of its answer: the cause is then switched off to see what the reader makes of it, and
does not count.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from codesign.adapt import FinishedRun
from codesign.batches import EXPERIMENT
from codesign.budget.entry import NONE, BudgetEntry, quadrature_difference
from codesign.budget.person import known_readings
from codesign.evaluate import AXIAL, ExperimentConfig, gaze_experiment
from codesign.eye import RenderedFrames
from codesign.gaze import CalibratedPerson, NetworkReadings, PersonCalibrator, angle_deg
from codesign.optics import (
    ImagingDevice,
    OpticsConfig,
    formed,
    image_difference,
    make_device,
)
from codesign.train import assess
from metalens.core.arrays import Array
from metalens.image import Imager, UniformImager
from metalens.lens import Layers

THINNED = 320  # frames that small changes of the optics are judged on


@dataclass(frozen=True, eq=False, slots=True)
class CalibratedStand:
    """Persons calibrated on the device as it is, and the frames on which a change of
    the optics is judged.
    """

    people: dict[int, CalibratedPerson]
    frames: tuple[RenderedFrames, ...]
    trial: gaze_experiment.ExperimentTrials


class NetworkReading:
    """A run's network with its frames; ``measured_deg`` is there once :meth:`path` is
    through.
    """

    def __init__(
        self, source: FinishedRun, config: ExperimentConfig, *, fwhm_nm: float
    ) -> None:
        self.source, self.config = source, config
        self.scenes = source.run.scenes(EXPERIMENT)
        self.sensor = gaze_experiment.experiment_sensors([source], config)[0]
        believed = source.run.trainer.optics
        width = fwhm_nm or believed.fwhm_nm
        self.optics: OpticsConfig = replace(believed, image="true", fwhm_nm=width)
        self.believed = gaze_experiment.prepare_run(source, image="trained")
        self._before: tuple[Imager | UniformImager, PersonCalibrator] | None = None
        self.subjects: list[RenderedFrames] = []
        trials = []
        for subject in range(config.subjects):
            states, trial = gaze_experiment.states_of(config, subject, self.scenes)
            self.subjects.append(
                gaze_experiment.render_subject(states, config, subject, self.scenes)
            )
            trials.append(trial)
        self.trial = gaze_experiment.join_subjects(trials)
        self.true = self._device(self.optics)
        self.measured_deg = {AXIAL: NONE, gaze_experiment.LATERAL: NONE}
        self._stand: CalibratedStand | None = None
        self._error_rad = 0.0

    @property
    def frame(self) -> int:
        """Samples of a frame along a side, margin included."""
        return (
            self.source.settings.scenes.pixels + 2 * self.source.settings.scenes.margin
        )

    def _device(self, settings: OpticsConfig) -> ImagingDevice:
        margin = self.source.settings.scenes.margin
        coefficients = self.source.run.trainer.model.coefficients_rad.detach()
        whole = formed.make_imager(settings, coefficients, self.frame, margin=margin)
        if not isinstance(whole, Imager):
            raise TypeError("a device is imaged truly")
        plane = formed.optics_of(settings, coefficients)
        return ImagingDevice(
            plane.wave, plane.layers, plane.distance_um, whole, settings.image_tolerance
        )

    def stands(self, wave: object, layers: Layers, distance_um: float) -> ImagingDevice:
        """The device of another lens plane behind films, on the frames of this run."""
        settings, margin = self.optics, self.source.settings.scenes.margin
        return make_device(
            wave,  # type: ignore[arg-type]
            formed.grid_of(settings, self.frame, margin),
            layers=layers,
            distance_um=distance_um,
            spectrum=formed.source_of(settings),
            field_rad=float(np.radians(settings.angle_deg)),
            tolerance=settings.image_tolerance,
        )

    def path(self) -> Iterator[BudgetEntry]:
        """Entries from the true pupil to the answered gaze, and what was measured at
        its end.
        """
        still = replace(self.config, fixation_deg=0.0)
        people = f"{self.config.subjects} subjects, {self.config.share:.0%} of their stimuli calibrate"
        said = f"true pupil and slippage; {people}"
        sphere = gaze_experiment.sphere_calibrator(self.source, self.config)
        yield self._grown(
            "subject and calibration",
            self._error(known_readings(still, self.scenes), sphere),
            said,
        )
        true = known_readings(self.config, self.scenes)
        said = f"scatter of {self.config.fixation_deg:g} deg about the stimulus"
        yield self._grown("fixation", self._error(true, sphere), said)
        yield from self._reader(true, sphere)
        read, how = self._read(self.believed)
        yield self._grown(
            "sensor noise", self._error(read, how), "frames with the sensor's noise"
        )
        for link, optics, psf, said in self._unknown():
            read, how = self._read(optics)
            yield replace(self._grown(link, self._error(read, how), said), psf=psf)
        self._settle(read, how)
        yield from self._known()

    def _reader(
        self, true: NetworkReadings, sphere: PersonCalibrator
    ) -> Iterator[BudgetEntry]:
        """The pupil as read with the true slippage, then all that is read.

        Who reads an axis needs the pupil less than the sphere does: alone it costs at
        most what all together costs.
        """
        said = f"network of {self.source.row['mmacs']:.3g} MMACs, noiseless frames of the image that it was trained on"
        read, how = self._read(self.believed, quiet=True)
        together = self._error(read, how)
        alone = self._error(NetworkReadings(read.pupil_mm, true.slip_mm), sphere)
        yield self._grown("reader, pupil", min(alone, together), said)
        yield self._grown("reader, slippage", together, said)

    def _grown(self, link: str, error_rad: float, method: str) -> BudgetEntry:
        """The entry of one more cause: what the error has more than before, in
        quadrature; 0 where it has less.
        """
        before, self._error_rad = self._error_rad, error_rad
        return BudgetEntry(
            link, NONE, NONE, quadrature_difference(error_rad, before), method
        )

    def _unknown(self) -> Iterator[tuple[str, Imager, float, str]]:
        """What the reader's training left out of its image, one more in each."""
        believed = self.source.run.trainer.optics
        if believed.image == "true" and believed.fwhm_nm == self.optics.fwhm_nm:
            return
        if believed.image == "true":
            said = f"{self.optics.fwhm_nm:g} nm before a reader trained at {believed.fwhm_nm:g} nm"
            yield "spectrum", self.true.whole, self._broadened(), said
            return
        one = self._device(replace(self.optics, fwhm_nm=0.0, filter_nm=0.0))
        said = "the whole field before a reader trained on the PSFs of one chief ray"
        yield (
            "field",
            one.evenly_lit(),
            image_difference(one.one_psf(), one.whole),
            said,
        )
        yield (
            "radiometry",
            one.whole,
            0.0,
            "cos⁴ and vignetting before a reader trained on even light",
        )
        if self.optics.fwhm_nm:
            said = (
                f"{self.optics.fwhm_nm:g} nm before a reader trained on one wavelength"
            )
            yield "spectrum", self.true.whole, self._broadened(), said

    def _broadened(self) -> float:
        """Relative L2 change of the PSFs from one wavelength to the light of the
        device.
        """
        narrow = self.true.one_wavelength(self.optics.wavelength_nm * 1e-3)
        return image_difference(narrow, self.true.whole)

    def _known(self) -> Iterator[BudgetEntry]:
        """What the reader was trained with, switched off."""
        believed, here = self.source.run.trainer.optics, self.true
        said = "known to the reader, switched off: what it answers then; not in the sum"
        if believed.image == "true":
            yield replace(
                self.changed("field", here.one_psf(), here.whole, said), counted=False
            )
            yield replace(
                self.changed("radiometry", here.evenly_lit(), here.whole, said),
                counted=False,
            )
        if not self.optics.fwhm_nm:
            yield BudgetEntry(
                "spectrum", NONE, 0.0, 0.0, "the light has one wavelength"
            )
        elif believed.image == "true" and believed.fwhm_nm == self.optics.fwhm_nm:
            narrow = here.one_wavelength(self.optics.wavelength_nm * 1e-3)
            yield replace(
                self.changed("spectrum", narrow, here.whole, said), counted=False
            )

    def changed(
        self,
        link: str,
        optics: Imager,
        base: Imager,
        method: str,
        *,
        phase_rad: float = NONE,
    ) -> BudgetEntry:
        """The entry of a change of the optics after the persons were calibrated: the
        turn of their answers.
        """
        gaze = self.turned(optics, base)
        return BudgetEntry(
            link, phase_rad, image_difference(optics, base), gaze, method
        )

    def turned(self, optics: Imager, base: Imager) -> float:
        """Mean angle, rad, between the answers to frames through two optics; the
        persons stay calibrated.

        Without noise: Poisson counts of frames that hardly differ are other draws, and
            would turn the answers more.
        """
        stand = self._stand
        if stand is None:
            raise RuntimeError("changes are judged once the path is through")
        one, other = (
            gaze_experiment.predicted_gaze(
                stand.people, self._frames(stand.frames, o, quiet=True), stand.trial
            )
            for o in (optics, base)
        )
        return float(np.radians(angle_deg(one, other).mean()))

    def turned_on_finer_image(self) -> float:
        """:meth:`turned` from the device's image to one of a quarter of its
        tolerance.
        """
        tolerance = self.optics.image_tolerance / assess.FINER
        fine = self._device(replace(self.optics, image_tolerance=tolerance))
        return self.turned(fine.whole, self.true.whole)

    def _settle(self, read: NetworkReadings, how: PersonCalibrator) -> None:
        """Keep the persons of the last state, what it measured, and a thin sample of
        the judged frames.
        """
        people = self._taught(read, how)
        error = angle_deg(
            gaze_experiment.predicted_gaze(people, read, self.trial),
            self.trial.stimulus_deg,
        )
        judged = self._judged()
        for kind in self.measured_deg:
            self.measured_deg[kind] = float(
                error[judged & self.trial.group(kind)].mean()
            )
        rows = np.flatnonzero(judged & self.trial.group(AXIAL))
        rows = rows[:: max(1, len(rows) // THINNED)]
        frames = tuple(
            _part(made, torch.from_numpy(rows[self.trial.subject[rows] == s] - first))
            for s, (made, first) in enumerate(
                zip(self.subjects, self._starts(), strict=True)
            )
        )
        fields = (
            getattr(self.trial, f)[rows]
            for f in gaze_experiment.ExperimentTrials.__slots__
        )
        self._stand = CalibratedStand(
            people, frames, gaze_experiment.ExperimentTrials(*fields)
        )

    def _starts(self) -> Array:
        return np.cumsum(
            [0, *(len(made.labels.slip_um) for made in self.subjects[:-1])]
        )

    def _off(self, angles_deg: Array) -> float:
        """Mean over the judged frames under axial slippage, rad."""
        return float(
            np.radians(angles_deg[self._judged() & self.trial.group(AXIAL)].mean())
        )

    def _judged(self) -> Array:
        return ~np.isin(
            np.arange(len(self.trial.subject)),
            gaze_experiment.calibration_frames(self.trial, self.config),
        )

    def _error(self, read: NetworkReadings, how: PersonCalibrator) -> float:
        """Mean error of the answers under axial slippage, rad, every person calibrated
        on what was read.
        """
        answers = gaze_experiment.predicted_gaze(
            self._taught(read, how), read, self.trial
        )
        return self._off(angle_deg(answers, self.trial.stimulus_deg))

    def _taught(
        self, read: NetworkReadings, how: PersonCalibrator
    ) -> dict[int, CalibratedPerson]:
        return gaze_experiment.calibrate_subjects(read, self.trial, self.config, how)

    def _read(
        self, optics: Imager | UniformImager, *, quiet: bool = False
    ) -> tuple[NetworkReadings, PersonCalibrator]:
        """What is read of all frames, and how people are calibrated whose frames come
        through these optics (noisy).
        """
        if self._before is None or self._before[0] is not optics:
            self._before = (
                optics,
                gaze_experiment.run_calibrator(
                    self.source, optics, self.config, self.sensor
                ),
            )
        return self._frames(self.subjects, optics, quiet=quiet), self._before[1]

    @torch.no_grad()
    def _frames(
        self,
        subjects: list[RenderedFrames] | tuple[RenderedFrames, ...],
        optics: Imager | UniformImager,
        *,
        quiet: bool = False,
    ) -> NetworkReadings:
        """What the network reads of frames through these optics; noise of the
        experiment's seeds.
        """
        found = []
        net, inner = self.source.run.trainer.model.net, self.source.settings.inner
        for subject, made in enumerate(subjects):
            seen = gaze_experiment.image_frames(
                self.source,
                made,
                optics,
                seed=gaze_experiment.NOISE + subject,
                sensor=self.sensor,
                quiet=quiet,
            )
            found.append(
                assess.predict_frames(net, self.source.architecture, seen, inner)
            )
        return gaze_experiment.read_from(found, self.source)


def _part(made: RenderedFrames, rows: torch.Tensor) -> RenderedFrames:
    """Some of the frames with their labels."""
    frames = type(made.frames)(
        *(getattr(made.frames, f)[rows] for f in type(made.frames).__slots__)
    )
    labels = type(made.labels)(
        *(getattr(made.labels, f)[rows] for f in type(made.labels).__slots__)
    )
    return replace(made, frames=frames, labels=labels, pupil=made.pupil[rows])
