"""The error budget of a lens: each link of the chain as phase, PSF and gaze error."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from characterize.inference import AsBuilt
from characterize.model import PLACE, process_state_of
from codesign.adapt import FinishedRun
from codesign.batches import EXPERIMENT
from codesign.evaluate import gaze_experiment as experiment
from codesign.eye import PinholeCamera, RenderedFrames, render
from codesign.gaze import CalibratedPerson, NetworkReadings, PersonCalibrator, angle_deg
from codesign.optics import MadeLens, OpticsConfig, formed
from codesign.settings import ExperimentConfig
from codesign.train import assess
from metalens.cell import Incidence
from metalens.core.arrays import Array
from metalens.core.errors import CellError, LensError, PropagationError, SceneError
from metalens.design import neighbours as supercell
from metalens.fabrication import Printed, State, draw_lenses
from metalens.image import Imager, Optics, node_light, normalise_psfs, with_psfs
from metalens.lens import Lens, NeighbourRows
from metalens.library import PillarLibrary, engines
from metalens.psf import SpectralNodes, among

NONE = math.nan
TOTAL, MEASURED = "all links", "measured, all at once"
SOLVED = 12  # diameters at which the pillar model is solved again
FINER = 30.0  # how much more precisely
LABELS = 64  # pixels of renderings whose labels alone are wanted
THINNED = 320  # frames that small changes of the optics are judged on


@dataclass(frozen=True, slots=True)
class BudgetEntry:
    """One link: rms phase error over the pillars (rad), relative L2 error of the PSFs,
    gaze error (rad, mean angle).

    nan where the link has none. method: how it was determined. counted: whether the
    sum holds it.
    """

    link: str
    phase_rad: float
    psf: float
    gaze_rad: float
    method: str
    counted: bool = True


def quadrature_difference(error: float, before: float) -> float:
    """What an error has more than before, in quadrature; 0 where it has less."""
    return math.sqrt(max(error**2 - before**2, 0.0))


def quadrature_total(rows: list[BudgetEntry]) -> BudgetEntry:
    """The root of the sum of squares of the rows that count; nan of what none knows."""

    def together(name: str) -> float:
        values = [getattr(e, name) for e in rows if e.counted]
        known = [v for v in values if math.isfinite(v)]
        return math.hypot(*known) if known else NONE

    missing = [e.link for e in rows if e.counted and math.isnan(e.gaze_rad)]
    without = f"; gaze without {', '.join(missing)}" if missing else ""
    return BudgetEntry(
        TOTAL,
        together("phase_rad"),
        together("psf"),
        together("gaze_rad"),
        f"root of the sum of squares{without}",
    )


@dataclass(frozen=True, slots=True)
class BudgetInputs:
    """What is known beside the lens: each adds its entries.

    fwhm_nm: of the light source. mask: of the PROCESS.toml. library: that the proxy was
    fitted to. asbuilt: of a fit. run: of a finished co-design run, whose network reads.
    frames: that it is shown. draws: of process and fit. tolerance: of the pillar solver,
    where no library says it.
    """

    fwhm_nm: float = 0.0
    mask: Printed | None = None
    library: PillarLibrary | None = None
    asbuilt: AsBuilt | None = None
    run: FinishedRun | None = None
    frames: ExperimentConfig = field(
        default_factory=lambda: ExperimentConfig(subjects=5)
    )
    draws: int = 4
    tolerance: float = 1e-3


def image_difference(one: Imager, other: Imager) -> float:
    """Relative L2 difference of the PSFs of two images over field and depth, each PSF
    of sum 1.

    Args:
        one: image to compare. other: the image it is compared with.
    """
    return float((one.stack - other.stack).norm() / other.stack.norm())


@dataclass(frozen=True, eq=False, slots=True)
class ImagingDevice:
    """A lens plane, its films and its sensor, with its image. Images of other optics
    share field points, depths, wavelengths and kernels: they differ by the cause alone.
    """

    optics: Optics
    whole: Imager

    @torch.no_grad()
    def image(self, optics: Optics) -> Imager:
        """The image through other optics."""
        light = node_light(optics, self.whole.plan).detach()
        return with_psfs(self.whole, *normalise_psfs(light, optics, self.whole.plan))

    def one_psf(self) -> Imager:
        """The image by the PSFs of the middle of the field alone."""
        stack = self.whole.stack
        rows, columns = (n // 2 for n in stack.shape[:2])
        same = stack[rows, columns].expand_as(stack).contiguous()
        return with_psfs(self.whole, same, self.whole.energy)

    def evenly_lit(self) -> Imager:
        """The image of a lens that collects as much light from every direction: no
        cos⁴, no vignetting.
        """
        level = self.whole.energy.mean().expand_as(self.whole.energy).contiguous()
        return with_psfs(self.whole, self.whole.stack, level)

    @torch.no_grad()
    def one_wavelength(self, wavelength_um: float) -> Imager:
        """The image in light of one wavelength.

        Args:
            wavelength_um: of the light.
        """
        waves = SpectralNodes(np.array([wavelength_um]), np.ones(1), 0.0)
        plan = replace(self.whole.plan, waves=waves)
        light = node_light(self.optics, plan).detach()
        return with_psfs(self.whole, *normalise_psfs(light, self.optics, plan))

    @torch.no_grad()
    def both_polarisations(self) -> Imager:
        """The image by the flux of both polarisations through the sensor; the device's
        own where it is that already.

        What they change is small and smooth: it is computed at 5 x 5 field points at
        most, and interpolated.
        """
        plan, optics = self.whole.plan, self.optics
        if plan.window.components:
            return self.whole
        y, x = (
            torch.linspace(float(a[0]), float(a[-1]), min(5, len(a)), dtype=a.dtype)
            for a in (plan.y_um, plan.x_um)
        )
        scalar, both = (
            node_light(
                optics,
                replace(
                    plan, y_um=y, x_um=x, window=replace(plan.window, components=count)
                ),
            )
            for count in (0, plan.window.whole)
        )
        to_y, to_x = (
            (1 - (wanted[:, None] - at).abs() / (at[1] - at[0])).clamp_min(0)
            for wanted, at in ((plan.y_um, y), (plan.x_um, x))
        )
        change = torch.einsum(
            "ya,xb,abzhw->yxzhw", to_y.to(both), to_x.to(both), both - scalar
        )
        light = node_light(optics, plan) + change
        return with_psfs(self.whole, *normalise_psfs(light, optics, plan))


class NetworkReading:
    """A run's network with the frames of the virtual experiment, and the persons that
    its answers calibrate. Changes of the optics are judged once :meth:`path` is through.
    """

    def __init__(self, source: FinishedRun, config: ExperimentConfig) -> None:
        """``source``: of the run. ``config``: what is shown to whom."""
        self.source, self.config = source, config
        self.scenes = source.run.scenes(EXPERIMENT)
        self.sensor = experiment.experiment_sensors([source], config)[0]
        self.subjects: list[RenderedFrames] = []
        trials = []
        for subject in range(config.subjects):
            states, trial = experiment.states_of(config, subject, self.scenes)
            self.subjects.append(
                experiment.render_subject(states, config, subject, self.scenes)
            )
            trials.append(trial)
        self.trial = experiment.join_subjects(trials)
        known = experiment.calibration_frames(self.trial, config)
        judged = ~np.isin(np.arange(len(self.trial.subject)), known)
        self.judged = judged & self.trial.group(experiment.AXIAL)
        self.measured_rad = NONE
        self._people: dict[int, CalibratedPerson] = {}
        self._thin: list[RenderedFrames] = []
        self._rows = np.empty(0, np.int64)

    def path(
        self, device: ImagingDevice, settings: OpticsConfig
    ) -> Iterator[BudgetEntry]:
        """Entries from the true pupil to the predicted gaze.

        Args:
            device: of the run's own lens in its true image, formed by ``settings``.
        """
        config, source = self.config, self.source
        sphere = experiment.sphere_calibrator(source, config)
        true = self._known(config)
        still = self._known(replace(config, fixation_deg=0.0))
        believed = experiment.prepare_run(source, image="trained")
        how = experiment.run_calibrator(source, believed, config, self.sensor)
        quiet, noisy = (
            self._read(self.subjects, believed, quiet=q) for q in (True, False)
        )
        together = self._error_rad(quiet, how)
        # who reads an axis needs the pupil less than the sphere does
        alone = self._error_rad(NetworkReadings(quiet.pupil_mm, true.slip_mm), sphere)
        net = f"network of {source.row['mmacs']:.3g} MMACs, noiseless frames as in training"
        people = (
            f"{config.subjects} subjects, {config.share:.0%} of their stimuli calibrate"
        )
        states = [
            ("subject and calibration", self._error_rad(still, sphere), NONE,
             f"true pupil and slippage; {people}"),
            ("fixation", self._error_rad(true, sphere), NONE,
             f"scatter of {config.fixation_deg:g} deg about the stimulus"),
            ("reader, pupil", min(alone, together), NONE, net),
            ("reader, slippage", together, NONE, net),
            ("sensor noise", self._error_rad(noisy, how), NONE, "frames with noise"),
        ]  # fmt: skip
        for link, optics, psf, method in self._untrained(device, settings):
            how = experiment.run_calibrator(source, optics, config, self.sensor)
            noisy = self._read(self.subjects, optics)
            states.append((link, self._error_rad(noisy, how), psf, method))
        before = 0.0
        for link, error, psf, method in states:
            grown = quadrature_difference(error, before)
            yield BudgetEntry(link, NONE, psf, grown, method)
            before = error
        self._keep(noisy, how)
        yield from self._trained(device, settings)

    def changed(
        self,
        link: str,
        optics: Imager,
        base: Imager,
        method: str,
        *,
        phase_rad: float = NONE,
    ) -> BudgetEntry:
        """The entry of a change of the optics after the persons were calibrated.

        Args:
            link: name of the row. base: image before the change.
            method: how the entry is determined. phase_rad: phase error of the pillars.
        """
        gaze = self.turn_rad(optics, base)
        psf = image_difference(optics, base)
        return BudgetEntry(link, phase_rad, psf, gaze, method)

    def turn_rad(self, optics: Imager, base: Imager) -> float:
        """Mean angle, rad, between the answers to noiseless frames through two optics;
        the persons stay calibrated.

        Args:
            base: image before the change.
        """
        trial = experiment.rows_of_trial(self.trial, self._rows)
        one, other = (
            experiment.predicted_gaze(
                self._people, self._read(self._thin, o, quiet=True), trial
            )
            for o in (optics, base)
        )
        return float(np.radians(angle_deg(one, other).mean()))

    def _known(self, config: ExperimentConfig) -> NetworkReadings:
        """Pupil and slippage of the experiment's frames as they are."""
        pupil, slip = [], []
        pitch = self.scenes.camera.pitch_um * self.scenes.camera.pixels / LABELS
        for subject in range(config.subjects):
            states, _ = experiment.states_of(config, subject, self.scenes)
            camera = PinholeCamera(LABELS, pitch)
            labels = render(states, rig=self.scenes.rig, camera=camera).labels
            pupil.append((labels.pupil_px - (LABELS - 1) / 2) * (pitch * 1e-3))
            slip.append(labels.slip_um * 1e-3)
        return NetworkReadings(*(torch.cat(v).double().numpy() for v in (pupil, slip)))

    def _untrained(
        self, device: ImagingDevice, settings: OpticsConfig
    ) -> Iterator[tuple[str, Imager, float, str]]:
        """What training left out of its image, one more in each."""
        believed = self.source.run.trainer.optics
        if believed.image == "uniform":
            one = device if not settings.fwhm_nm else replace(
                device, whole=device.one_wavelength(settings.wavelength_nm * 1e-3)
            )  # fmt: skip
            psf = image_difference(one.one_psf(), one.whole)
            method = "the whole field; training had the PSFs of one chief ray"
            yield "field", one.evenly_lit(), psf, method
            method = "cos⁴ and vignetting; training had even light"
            yield "radiometry", one.whole, 0.0, method
        if settings.fwhm_nm and believed.fwhm_nm != settings.fwhm_nm:
            narrow = device.one_wavelength(settings.wavelength_nm * 1e-3)
            psf = image_difference(narrow, device.whole)
            method = f"{settings.fwhm_nm:g} nm; training had {believed.fwhm_nm:g} nm"
            yield "spectrum", device.whole, psf, method

    def _trained(
        self, device: ImagingDevice, settings: OpticsConfig
    ) -> Iterator[BudgetEntry]:
        """What the network was trained with, switched off; not in the sum."""
        believed = self.source.run.trainer.optics
        method = "trained with, switched off"
        cases: list[tuple[str, Imager]] = []
        if believed.image == "true":
            cases += [("field", device.one_psf()), ("radiometry", device.evenly_lit())]
            if settings.fwhm_nm and believed.fwhm_nm == settings.fwhm_nm:
                narrow = device.one_wavelength(settings.wavelength_nm * 1e-3)
                cases.append(("spectrum", narrow))
        for link, optics in cases:
            entry = self.changed(
                link, optics, device.whole, f"{method}; not in the sum"
            )
            yield replace(entry, counted=False)

    def _keep(self, read: NetworkReadings, how: PersonCalibrator) -> None:
        """Keep the persons of the last state, what it measured, and a thin sample of
        the judged frames.
        """
        self._people = experiment.calibrate_subjects(read, self.trial, self.config, how)
        self.measured_rad = self._error_rad(read, how)
        rows = np.flatnonzero(self.judged)
        self._rows = rows[:: max(1, len(rows) // THINNED)]
        each = len(self.trial.subject) // len(self.subjects)
        self._thin = [
            made.rows(torch.from_numpy(self._rows[self._rows // each == s] - s * each))
            for s, made in enumerate(self.subjects)
        ]

    def _error_rad(self, read: NetworkReadings, how: PersonCalibrator) -> float:
        """Mean error of the answers under axial slippage, every person calibrated on
        what was read.
        """
        answers, _ = experiment.calibrated_gaze(read, self.trial, self.config, how)
        angles = angle_deg(answers, self.trial.stimulus_deg)[self.judged]
        return float(np.radians(angles.mean()))

    @torch.no_grad()
    def _read(
        self, subjects: list[RenderedFrames], optics: Imager, *, quiet: bool = False
    ) -> NetworkReadings:
        """What the network reads of frames through these optics; noise of the
        experiment's seeds.
        """
        net = self.source.run.trainer.model.net
        inner = self.source.settings.inner
        read = []
        for subject, made in enumerate(subjects):
            frames = experiment.image_frames(
                self.source, made, optics, seed=experiment.NOISE + subject,
                sensor=self.sensor, quiet=quiet,
            )  # fmt: skip
            read.append(
                assess.predict_frames(net, self.source.architecture, frames, inner)
            )
        return experiment.read_from(read, self.source)


class ErrorBudget:
    """The lens as a device whose causes are changed one by one, and who reads its
    images.
    """

    def __init__(self, lens: Lens, given: BudgetInputs) -> None:
        """Prepare the device of the designed pillars, and the run's network.

        Args:
            lens: to judge. given: what is known beside it.

        Raises:
            LensError: the run's lens is another than the one given; turned pillars, or
                another lattice than a square one. ProcessError: a spread of what these
                pillars do not have.
            SceneError, PropagationError: as :func:`metalens.image.imager`.
        """
        if not lens.diameters.plain:
            raise LensError(
                f"pillars on a {lens.diameters.lattice.kind} lattice: need a square one, none turned"
            )
        if given.mask is not None:
            given.mask.spread.check(lens.cell)
        self.lens, self.given = lens, given
        self.smooth: ImagingDevice | None = None
        self.reading: NetworkReading | None = None
        if given.run is None:
            self.settings, frame, margin = settings_of(lens, given.fwhm_nm), 80, 8
        else:
            trainer = given.run.run.trainer
            scenes = given.run.settings.scenes
            refuse_other_lens(lens, given.run.settings.optics)
            width = given.fwhm_nm or trainer.optics.fwhm_nm
            self.settings = replace(trainer.optics, image="true", fwhm_nm=width)
            margin = scenes.margin
            frame = scenes.pixels + 2 * margin
            self.reading = NetworkReading(given.run, given.frames)
            coefficients = trainer.model.coefficients_rad.detach()
            plane = formed.optics_of(self.settings, coefficients)
            self.smooth = self._device(plane, frame, margin)
        self.made = MadeLens(lens, self.settings)
        self.coupling: Array | None = None
        if lens.neighbours is not None:
            self.coupling = self._coupling(lens.neighbours)
        self.base = self._pillars()
        self.device = self._device(self._optics(), frame, margin)
        self._frame = frame, margin

    @property
    def above(self) -> list[str]:
        """Why the errors of the images are above their tolerance."""
        devices = (self.device, self.smooth)
        asked = self.settings.image_tolerance
        return [one.whole.above(asked) for one in devices if one is not None]

    def entries(self) -> Iterator[BudgetEntry]:
        """The budget, link by link from gaze back to the pillars, ending with the sum.

        Raises:
            LensError: the as-built file is of another lens.
        """
        rows: list[BudgetEntry] = []
        parts = (
            self._network, self._image_tolerance, self._pillar_device, self._solver,
            self._neighbours, self._mask, self._process, self._calibration,
        )  # fmt: skip
        for part in parts:
            for entry in part():
                rows.append(entry)
                yield entry
        if self.reading is not None:
            method = f"virtual experiment on these {self.given.frames.frames} frames"
            gaze = self.reading.measured_rad
            yield BudgetEntry(MEASURED, NONE, NONE, gaze, method, counted=False)
        yield quadrature_total(rows)

    def _device(self, optics: Optics, frame: int, margin: int) -> ImagingDevice:
        whole = formed.imager_through(self.settings, optics, frame, margin=margin)
        return ImagingDevice(optics, whole)

    def _optics(self, state: State | None = None, *, factor: Array | None = None,
                made: MadeLens | None = None, shift_um: float = 0.0) -> Optics:  # fmt: skip
        """The lens plane of a process state (the design's without one), its films and
        the sensor moved away by ``shift_um``.
        """
        both = self.coupling if factor is None else factor
        plane = (made or self.made).plane(state or State.of(), factor=both)
        distance = self.lens.sensor_distance_um + shift_um
        return Optics(plane, self.lens.layers, distance)

    def _pillars(self, state: State | None = None, *, factor: Array | None = None,
                 made: MadeLens | None = None) -> Array:  # fmt: skip
        both = self.coupling if factor is None else factor
        found = (made or self.made).pillars(state or State.of(), factor=both).numpy()
        return np.asarray(found[self.lens.diameters.diameter_um > 0])

    def _coupling(self, rows: NeighbourRows) -> Array:
        """(y, x) factor of unlike neighbours on every pillar."""
        alone = self.made.pillars(State.of())
        pitch = self.lens.diameters.pitch_um
        return np.asarray(among.mean_coupling(alone, rows, pitch).numpy())

    def _entry(
        self, link: str, optics: Imager, method: str, *, pillars: Array | None = None
    ) -> BudgetEntry:
        """The entry of a change of the device. pillars: t of the changed pillars."""
        phase = NONE if pillars is None else scatter_rad(pillars, self.base)
        if self.reading is not None:
            whole = self.device.whole
            return self.reading.changed(link, optics, whole, method, phase_rad=phase)
        psf = image_difference(optics, self.device.whole)
        return BudgetEntry(link, phase, psf, NONE, method)

    def _changed(self, link: str, method: str, state: State | None = None, *,
                 factor: Array | None = None, made: MadeLens | None = None,
                 shift_um: float = 0.0) -> BudgetEntry:  # fmt: skip
        """The entry of other pillars, or of the sensor elsewhere."""
        about = {"factor": factor, "made": made}
        optics = self._optics(state, shift_um=shift_um, **about)  # type: ignore[arg-type]
        pillars = self._pillars(state, **about)  # type: ignore[arg-type]
        return self._entry(link, self.device.image(optics), method, pillars=pillars)

    def _network(self) -> Iterator[BudgetEntry]:
        if self.reading is None or self.smooth is None:
            method = "not known: no run was given (--run)"
            yield BudgetEntry("reader", NONE, NONE, NONE, method)
            return
        yield from self.reading.path(self.smooth, self.settings)

    def _image_tolerance(self) -> Iterator[BudgetEntry]:
        """The image of training against one formed at a quarter of its tolerance."""
        link = "image tolerance"
        fine = assess.finer_image(self.settings)
        if self.reading is None or self.smooth is None or fine is None:
            return
        asked = fine.image_tolerance, self.settings.image_tolerance
        method = "image formed at {:g} in place of {:g}".format(*asked)
        frame, margin = self._frame
        try:
            exact = formed.imager_through(
                fine, self.smooth.optics, frame, margin=margin
            )
        except (SceneError, PropagationError) as problem:
            yield BudgetEntry(link, NONE, NONE, NONE, f"not known: {problem}")
            return
        turn = self.reading.turn_rad(exact, self.smooth.whole)
        yield BudgetEntry(link, NONE, NONE, turn, method)

    def _pillar_device(self) -> Iterator[BudgetEntry]:
        """Pillars in place of the smooth phase, films, both polarisations."""
        if self.reading is not None and self.smooth is not None:
            method = (
                "pillars of the lens file; training had a smooth phase without films"
            )
            smooth = self.device.image(self.smooth.optics)
            whole = self.device.whole
            yield self.reading.changed("pillars on a lattice", whole, smooth, method)
        layers = self.lens.layers
        if layers.films:
            optics = self.device.optics
            bare = replace(optics, layers=replace(layers, front=(), behind=()))
            method = f"{len(layers.films)} films of the lens file taken away"
            yield self._entry("glass", self.device.image(bare), method)
        method = "flux of both polarisations through the sensor in place of one scalar"
        yield self._entry("polarisation", self.device.both_polarisations(), method)

    def _solver(self) -> Iterator[BudgetEntry]:
        """Solver and proxy, against the solver at thirty times the precision."""
        lens, library = self.lens, self.given.library
        at = np.linspace(*supercell.drawn_diameter_range(lens), SOLVED)
        tolerance = library.sweep.bar if library else self.given.tolerance
        engine = engines.choose_engine(lens.cell)
        solve = engines.solve_to_tolerance(
            lens.cell, Incidence(lens.wavelength_um), tolerance=tolerance / FINER, engine=engine
        )  # fmt: skip
        exact = np.array([solve(float(d)).t for d in at])
        proxy = lens.proxy.transmission(at, lens.wavelength_um) * np.exp(
            1j * lens.proxy.phase_rad(at, lens.wavelength_um)
        )
        method = f"{engine} solver at {tolerance / FINER:.0e}, {SOLVED} diameters"
        cases = [("pillar solver and proxy", exact / proxy, f"against the {method}")]
        if library is not None:
            stored = stored_response(library, at, lens.wavelength_um)
            cases = [
                ("pillar solver", exact / stored, f"library against the {method}"),
                ("proxy", stored / proxy, f"against the library, {SOLVED} diameters"),
            ]
        for link, ratio, words in cases:
            log = np.log(np.abs(ratio)) + 1j * np.unwrap(np.angle(ratio))
            d = lens.diameters.diameter_um
            factor = np.exp(
                np.interp(d, at, log.real) + 1j * np.interp(d, at, log.imag)
            )
            both = factor if self.coupling is None else factor * self.coupling
            yield self._changed(link, words, factor=both)

    def _neighbours(self) -> Iterator[BudgetEntry]:
        """Local periodic approximation: rows of unlike pillars solved as one; where the
        lens holds them, what is open of them.
        """
        lens = self.lens
        if lens.neighbours is not None:
            others = lens.neighbours.doubted(turning_sine(lens))
            rows = [self._of_rows(other, "") for other in others]
            values = [(e.phase_rad, e.psf, e.gaze_rad) for e in rows]
            rms = [math.hypot(*column) for column in zip(*values, strict=True)]
            method = "rows of the lens file: another truncation, a row left out, zones that get shorter"
            yield BudgetEntry("neighbours", rms[0], rms[1], rms[2], method)
            return
        try:
            rows_of = supercell.estimate_neighbour_coupling(lens)
        except CellError:
            return  # films or tilted walls: rows of those are not solved
        counts = ", ".join(map(str, row_lengths(rows_of, lens.cell.pitch_um)))
        yield self._of_rows(
            rows_of, f"rows of {counts} unlike pillars solved as one cell"
        )

    def _of_rows(self, rows: NeighbourRows, method: str) -> BudgetEntry:
        return self._changed("neighbours", method, factor=self._coupling(rows))

    def _mask(self) -> Iterator[BudgetEntry]:
        """Diameters as the mask holds them, where one is given."""
        if self.given.mask is None:
            return
        step_um = self.given.mask.diameter_step_nm * 1e-3
        plain = self.lens.diameters
        rounded = np.rint(plain.diameter_um / step_um) * step_um
        there = replace(plain, diameter_um=rounded.astype(np.float32))
        drawn = self.made.redrawn(replace(self.lens, diameters=there))
        method = f"every diameter rounded to {step_um * 1e3:g} nm"
        yield self._changed("mask grid", method, made=drawn)

    def _process(self) -> Iterator[BudgetEntry]:
        """Draws of the process; what a fit of the built lens would take out again."""
        if self.given.mask is None:
            return
        spread, count = self.given.mask.spread, self.given.draws
        lenses = [(draw.state(), 0.0) for draw in draw_lenses(spread, count, seed=5)]
        method = f"{count} draws of the process, lens not measured"
        yield self._rms("process spread", lenses, method)

    def _calibration(self) -> Iterator[BudgetEntry]:
        """What the fit of the built lens leaves open: draws of its posterior against
        its best estimate.
        """
        fitted = self.given.asbuilt
        if fitted is None:
            return
        mine, its = (x.diameters.diameter_um for x in (self.lens, fitted.design))
        if mine.shape != its.shape or not np.allclose(mine, its, atol=1e-6):
            raise LensError(
                "the as-built file is of another lens than the one given; give the lens that was captured"
            )
        best, lenses = fitted.parameters(), []
        for row in fitted.lens_samples(self.given.draws, seed=3):
            off = fitted.parameters(row) - best
            lenses.append((process_state_of(off), float(off[PLACE["distance_um"]])))
        method = f"{len(lenses)} draws of the fit's posterior against its best estimate"
        yield self._rms("calibration of the lens", lenses, method)

    def _rms(
        self, link: str, lenses: list[tuple[State, float]], method: str
    ) -> BudgetEntry:
        """Root mean square over process states and shifts of the sensor."""
        rows = [self._changed(link, method, s, shift_um=shift) for s, shift in lenses]
        values = np.array([(e.phase_rad, e.psf, e.gaze_rad) for e in rows])
        rms = np.sqrt((values**2).mean(0)).tolist()
        return BudgetEntry(link, rms[0], rms[1], rms[2], method)


def settings_of(lens: Lens, fwhm_nm: float) -> OpticsConfig:
    """Image settings for a lens file without a run: pixels of 18 um, a field of 64 of
    them, its own films and light of width ``fwhm_nm``.
    """
    return OpticsConfig(
        aperture_mm=2e-3 * lens.diameters.radius_um,
        sensor_distance_mm=1e-3 * lens.sensor_distance_um,
        wavelength_nm=1e3 * lens.wavelength_um,
        focus_mm=1e-3 * lens.source_distance_um,
        polynomials=0,
        sample_um=18.0,
        window_samples=17,
        layers=lens.layers,
        fwhm_nm=fwhm_nm,
        image_tolerance=0.03,
        cell=lens.cell,
    )


def refuse_other_lens(lens: Lens, optics: OpticsConfig) -> None:
    """Refuse a network that was trained for another lens: one that differs by more than
    2 %.

    Args:
        lens: that is judged. optics: of the network's run.

    Raises:
        LensError: sensor distance, wavelength or aperture differ.
    """
    mine = (
        lens.sensor_distance_um * 1e-3,
        lens.wavelength_um * 1e3,
        2e-3 * lens.diameters.radius_um,
    )
    its = optics.sensor_distance_mm, optics.wavelength_nm, optics.aperture_mm
    if any(abs(a - b) > 0.02 * b for a, b in zip(mine, its, strict=True)):
        raise LensError(
            "the run's network was trained for another lens: sensor distance, wavelength, aperture are "
            f"{its[0]:g} mm, {its[1]:g} nm, {its[2]:g} mm there and {mine[0]:g} mm, {mine[1]:g} nm, {mine[2]:g} mm in "
            "the lens file; give the lens.h5 of the run"
        )


def scatter_rad(changed: Array, base: Array) -> float:
    """Standard deviation over pillars of the phase between two complex transmissions
    (pillars,); a common phase is no error.

    Args:
        changed: (pillars,) complex t of the changed pillars.
        base: (pillars,) complex t of the design.
    """
    turn = changed * base.conj()
    mean = np.exp(1j * np.angle(turn)).sum()
    return float(np.angle(turn * np.conj(mean)).std())


def stored_response(
    library: PillarLibrary, at_um: Array, wavelength_um: float
) -> Array:
    """(*at) complex t of a library at the nearest of its wavelengths, the mean of both
    polarisations; level and unwrapped phase are linear between its diameters.

    Args:
        at_um: diameters. wavelength_um: of the light.
    """
    near = int(np.argmin(np.abs(library.wavelength_um - wavelength_um)))
    t = library.t[:, 0, near].mean(0)
    level, phase = (
        np.interp(at_um, library.diameter_um, part)
        for part in (np.abs(t), np.unwrap(np.angle(t)))
    )
    return np.asarray(level * np.exp(1j * phase))


def row_lengths(rows: NeighbourRows, pitch_um: float) -> list[int]:
    """Pillars of every row along the lattice of ``pitch_um``: it turns light by one
    wave over its length.

    Args:
        rows: rows of unlike pillars.
    """
    return [round(n) for n in rows.wavelength_um / rows.sine[~rows.diagonal] / pitch_um]


def turning_sine(lens: Lens) -> Array:
    """(y, x) sine by which the lens turns light from its design source to the sensor."""
    d = lens.diameters
    r = np.hypot(d.x_um, d.y_um[:, None])
    source = lens.source_distance_um
    behind = 0.0 if math.isinf(source) else np.sin(np.arctan(r / source))
    return np.asarray(np.sin(np.arctan(r / lens.sensor_distance_um)) + behind)
