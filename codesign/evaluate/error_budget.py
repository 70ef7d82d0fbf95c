"""The error budget of a lens: each link of the chain as phase, PSF and gaze error."""

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from characterize.inference import AsBuilt
from characterize.model import PLACE, process_state_of
from codesign.adapt import FinishedRun
from codesign.adapt.source import check_lens
from codesign.batches import EXPERIMENT
from codesign.evaluate import gaze_experiment as experiment
from codesign.eye import RenderedFrames
from codesign.gaze import NetworkReadings, PersonCalibrator, SphereCalibrator, angle_deg
from codesign.optics import MadeLens, OpticsConfig, image_formation
from codesign.optics.stack import lens_settings
from codesign.settings import ExperimentConfig
from metalens.cell import Incidence
from metalens.core.arrays import Array
from metalens.core.errors import CellError, LensError
from metalens.design import neighbours as supercell
from metalens.fabrication import PrintedProcess, State, draw_lenses
from metalens.image import Imager, Optics, node_light, normalise_psfs, with_psfs
from metalens.lens import Lens, NeighbourRows
from metalens.library import PillarLibrary, workers
from metalens.psf import neighbour_coupling

NONE = math.nan
TOTAL, MEASURED = "all links", "measured, all at once"
SOLVED = 12  # diameters at which pillars are solved again


@dataclass(frozen=True, slots=True)
class BudgetEntry:
    """Errors by one link of the chain; nan where the link has none.

    phase_rad: rms phase error over the pillars. psf: relative L2 error of the PSFs.
    gaze_rad: gaze error, mean angle. method: how it was determined.
    counted: whether the sum includes it.
    """

    link: str
    phase_rad: float
    psf: float
    gaze_rad: float
    method: str
    counted: bool = True


def quadrature_total(rows: list[BudgetEntry]) -> BudgetEntry:
    """Root of the sum of squares of the counted rows, column by column.

    Rows without a value (nan) are left out; nan where no row has one.
    """

    def root_sum_square(name: str) -> float:
        values = np.array([getattr(row, name) for row in counted])
        known = values[np.isfinite(values)]
        return float(np.linalg.norm(known)) if len(known) else NONE

    counted = [row for row in rows if row.counted]
    method = "root of the sum of squares"
    without_gaze = [row.link for row in counted if math.isnan(row.gaze_rad)]
    if without_gaze:
        method += f"; gaze without {', '.join(without_gaze)}"
    phase_rad, psf, gaze_rad = map(root_sum_square, ("phase_rad", "psf", "gaze_rad"))
    return BudgetEntry(TOTAL, phase_rad, psf, gaze_rad, method)


@dataclass(frozen=True, slots=True)
class BudgetInputs:
    """Optional inputs of the budget; each adds its links.

    fwhm_nm: spectral width of the light source. mask: grid and spread of PROCESS.toml.
    library: pillar library that the proxy was fitted to. asbuilt: fit of the built
    lens.
    run: finished co-design run with its network. frames: experiment that it reads.
    draws: number of draws of process and fit.
    tolerance: of the pillar solver, where no library states it.
    """

    fwhm_nm: float = 0.0
    mask: PrintedProcess | None = None
    library: PillarLibrary | None = None
    asbuilt: AsBuilt | None = None
    run: FinishedRun | None = None
    frames: ExperimentConfig = field(
        default_factory=lambda: ExperimentConfig(subjects=5)
    )
    draws: int = 4
    tolerance: float = 1e-3


def image_difference(one: Imager, other: Imager) -> float:
    """|p - q| / |q|: relative L2 difference of the PSFs of two imagers over field and
    depth, each PSF of sum 1.

    Args:
        one: imager of the PSFs p.
        other: imager of the PSFs q.
    """
    return float((one.stack - other.stack).norm() / other.stack.norm())


@torch.no_grad()
def image_through(optics: Optics, base: Imager) -> Imager:
    """Imager of other optics at the field points, depths, wavelengths and kernels of
    ``base``, so that the two differ by the optics alone.
    """
    light = node_light(optics, base.plan).detach()
    return with_psfs(base, *normalise_psfs(light, optics, base.plan))


class NetworkReading:
    """A run's network with the frames of the virtual experiment, and the calibrated
    persons.

    :meth:`path` calibrates the persons; :meth:`turn_rad` needs it first.
    """

    def __init__(self, source: FinishedRun, config: ExperimentConfig) -> None:
        """Render the frames of all subjects.

        Args:
            source: finished run with its network.
            config: subjects, stimuli, slippage and calibration.
        """
        self.source, self.config = source, config
        self.scenes = source.run.scenes(EXPERIMENT)
        self.sensor = experiment.experiment_sensors([source], config)[0]
        self.subjects: list[RenderedFrames] = []
        trials = []
        for subject in range(config.subjects):
            states, trial = experiment.draw_trials(config, subject, self.scenes)
            self.subjects.append(
                experiment.render_subject(states, config, subject, self.scenes)
            )
            trials.append(trial)
        self.trial = experiment.join_subjects(trials)
        calibration = experiment.calibration_frames(self.trial, config)
        self.judged = self.trial.group(experiment.AXIAL)
        self.judged[calibration] = False
        rows = np.flatnonzero(self.judged)
        # some 320 frames judge small changes of the optics
        self._rows = rows[:: max(1, len(rows) // 320)]
        self._thinned = [
            frames.rows(torch.from_numpy(self._rows[of_subject] % len(states)))
            for subject, frames in enumerate(self.subjects)
            for of_subject in [self.trial.subject[self._rows] == subject]
        ]
        self.measured_rad = NONE

    def path(self, image: Imager, settings: OpticsConfig) -> Iterator[BudgetEntry]:
        """Entries of the links from the true pupil to the predicted gaze.

        The chain starts at the true pupil and slippage and adds one link a state. A
        link's error is the growth of the gaze error in quadrature.

        Args:
            image: true image of the run's lens.
            settings: optics that ``image`` was formed by.
        """
        config, source = self.config, self.source
        camera = self.scenes.camera
        pupil_px = torch.cat([frames.labels.pupil_px for frames in self.subjects])
        centred_px = pupil_px.double().numpy() - (camera.pixels - 1) / 2
        pupil_mm = centred_px * camera.pitch_um * 1e-3
        exact = NetworkReadings(pupil_mm, self.trial.slip_mm)
        trained_imager = experiment.prepare_run(source, image="trained")
        calibrator = experiment.run_calibrator(
            source, trained_imager, config, self.sensor
        )
        quiet, noisy = (
            self._read(self.subjects, trained_imager, quiet=is_quiet)
            for is_quiet in (True, False)
        )
        sphere = SphereCalibrator(self.scenes.rig, config.hidden, config.seed)
        states = [
            ("subject and calibration", exact, sphere,
             f"true pupil and slippage; fixation scatters by {config.fixation_deg:g} deg; {config.subjects} subjects, "
             f"{config.share:.0%} of their stimuli calibrate"),
            ("reader", quiet, calibrator,
             f"network of {source.row['mmacs']:.3g} MMACs, noiseless frames as in training"),
            ("sensor noise", noisy, calibrator, "frames with noise"),
        ]  # fmt: skip
        trained = source.run.trainer.optics
        if (trained.image, trained.fwhm_nm) != (settings.image, settings.fwhm_nm):
            calibrator = experiment.run_calibrator(source, image, config, self.sensor)
            noisy = self._read(self.subjects, image)
            had = "one PSF for all" if trained.image == "uniform" else "it"
            states.append((
                "image of training", noisy, calibrator,
                f"the whole field in light of {settings.fwhm_nm:g} nm; training had {had} in {trained.fwhm_nm:g} nm",
            ))  # fmt: skip
        error_rad = 0.0
        for link, read, how, method in states:
            before_rad, error_rad = error_rad, self._error_rad(read, how)
            growth = math.sqrt(max(error_rad**2 - before_rad**2, 0.0))
            yield BudgetEntry(link, NONE, NONE, growth, method)
        self.measured_rad = error_rad
        self._people = experiment.calibrate_subjects(
            noisy, self.trial, config, calibrator
        )

    def turn_rad(self, optics: Imager, base: Imager) -> float:
        """Mean angle in rad between the gaze predicted from noiseless frames through
        two imagers, by the same calibrations.

        Args:
            optics: imager after the change.
            base: imager before the change.
        """
        one, other = (
            experiment.predicted_gaze(
                self._people,
                self._read(self._thinned, imager, quiet=True),
                self.trial[self._rows],
            )
            for imager in (optics, base)
        )
        return float(np.radians(angle_deg(one, other).mean()))

    def _error_rad(self, read: NetworkReadings, calibrator: PersonCalibrator) -> float:
        """Mean gaze error in rad under axial slippage, with calibrations from the same
        readings.
        """
        predicted, _ = experiment.calibrated_gaze(
            read, self.trial, self.config, calibrator
        )
        angles = angle_deg(predicted, self.trial.stimulus_deg)[self.judged]
        return float(np.radians(angles.mean()))

    @torch.no_grad()
    def _read(
        self, subjects: list[RenderedFrames], optics: Imager, *, quiet: bool = False
    ) -> NetworkReadings:
        """Readings of the network from frames through an imager, with the noise of the
        experiment's seeds or ``quiet``.
        """
        predictions = [
            experiment.predict_rendered(
                self.source,
                rendered,
                optics,
                seed=experiment.NOISE + subject,
                sensor=self.sensor,
                quiet=quiet,
            )
            for subject, rendered in enumerate(subjects)
        ]
        return experiment.collect_readings(predictions, self.source)


class ErrorBudget:
    """Error budget of a lens: each cause of error is changed by itself, and its effect
    on phase, PSFs and gaze computed.
    """

    def __init__(self, lens: Lens, given: BudgetInputs) -> None:
        """Prepare the device of the designed pillars, and the run's network.

        Args:
            lens: lens to judge.
            given: optional inputs, which add links.

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
        self.reading: NetworkReading | None = None
        frame, margin = 80, 8
        if given.run is None:
            self.settings = lens_settings(lens, given.fwhm_nm)
        else:
            trainer = given.run.run.trainer
            scenes = given.run.settings.scenes
            refuse_other_lens(lens, given.run.settings.optics)
            width = given.fwhm_nm or trainer.optics.fwhm_nm
            self.settings = replace(trainer.optics, image="true", fwhm_nm=width)
            margin = scenes.margin
            frame = scenes.pixels + 2 * margin
            self.reading = NetworkReading(given.run, given.frames)
            self.smooth_rad = trainer.model.coefficients_rad.detach()
            self.smooth = image_formation.make_imager(
                self.settings, self.smooth_rad, frame, margin=margin
            )
        self.made = MadeLens(lens, self.settings)
        rows = lens.neighbours
        self.coupling = None if rows is None else self._coupling(rows)
        self.base = self._pillars(self.made, State.of(), self.coupling)
        plane = self.made.plane(State.of(), factor=self.coupling)
        self.optics = Optics(plane, lens.layers, lens.sensor_distance_um)
        self.image = image_formation.imager_through(
            self.settings, self.optics, frame, margin=margin
        )

    @property
    def above(self) -> list[str]:
        """Sentences on images whose error exceeds the tolerance."""
        images = [self.image] + ([] if self.reading is None else [self.smooth])
        return [image.above(self.settings.image_tolerance) for image in images]

    def entries(self) -> Iterator[BudgetEntry]:
        """The budget, link by link from gaze back to the pillars, ending with the sum.

        Raises:
            FitError: the as-built file is of another lens.
        """
        rows: list[BudgetEntry] = []
        unknown = "not known: no run was given (--run)"
        path: Iterable[BudgetEntry] = [BudgetEntry("reader", NONE, NONE, NONE, unknown)]
        if self.reading is not None:
            path = self.reading.path(self.smooth, self.settings)
        for entry in itertools.chain(
            path, self._pillar_device(), self._solver(), self._neighbours(),
            self._mask(), self._process(), self._calibration(),
        ):  # fmt: skip
            rows.append(entry)
            yield entry
        if self.reading is not None:
            method = f"virtual experiment on these {self.given.frames.frames} frames"
            gaze = self.reading.measured_rad
            yield BudgetEntry(MEASURED, NONE, NONE, gaze, method, counted=False)
        yield quadrature_total(rows)

    def _pillars(self, made: MadeLens, state: State, factor: Array | None) -> Array:
        """(pillars,) complex t of a made lens in a process state."""
        t = made.pillars(state, factor=factor).numpy()
        return np.asarray(t[self.lens.diameters.diameter_um > 0])

    def _coupling(self, rows: NeighbourRows) -> Array:
        """(y, x) complex factor on every pillar by coupling to unequal neighbours."""
        alone = self.made.pillars(State.of())
        pitch = self.lens.diameters.pitch_um
        return np.asarray(neighbour_coupling.mean_coupling(alone, rows, pitch).numpy())

    def _entry(
        self, link: str, image: Imager, method: str, *, phase_rad: float = NONE,
        base: Imager | None = None,
    ) -> BudgetEntry:  # fmt: skip
        """Entry of a change of the image: PSF difference, and turn of the gaze with a
        network.

        Args:
            link: name of the row.
            image: imager after the change.
            method: how the entry is determined.
            phase_rad: phase error of the pillars.
            base: imager before the change; the designed device without it.
        """
        base = base or self.image
        turn = NONE if self.reading is None else self.reading.turn_rad(image, base)
        return BudgetEntry(link, phase_rad, image_difference(image, base), turn, method)

    def _changed(
        self, link: str, method: str, state: State | None = None, *,
        factor: Array | None = None, made: MadeLens | None = None, shift_um: float = 0.0,
    ) -> BudgetEntry:  # fmt: skip
        """Entry of changed pillars or a shifted sensor.

        Args:
            link: name of the row. method: how the entry is determined.
            state: process state; the design's without it.
            factor: (y, x) factor on the pillars' transmission; the neighbour coupling
                without it.
            made: manufactured lens in place of the designed one.
            shift_um: shift of the sensor away from the lens.
        """
        made, state = made or self.made, state or State.of()
        factor = self.coupling if factor is None else factor
        distance_um = self.lens.sensor_distance_um + shift_um
        optics = Optics(made.plane(state, factor=factor), self.lens.layers, distance_um)
        phase_rad = scatter_rad(self._pillars(made, state, factor), self.base)
        image = image_through(optics, self.image)
        return self._entry(link, image, method, phase_rad=phase_rad)

    def _pillar_device(self) -> Iterator[BudgetEntry]:
        """Entries of discrete pillars, of the films and of both polarisations."""
        if self.reading is not None:
            method = (
                "pillars of the lens file; training had a smooth phase without films"
            )
            smooth = image_formation.optics_of(self.settings, self.smooth_rad)
            base = image_through(smooth, self.image)
            yield self._entry("pillars on a lattice", self.image, method, base=base)
        layers = self.lens.layers
        if layers.films:
            bare = replace(self.optics, layers=replace(layers, front=(), behind=()))
            method = f"{len(layers.films)} films of the lens file taken away"
            yield self._entry("glass", image_through(bare, self.image), method)
        method = "flux of both polarisations through the sensor in place of one scalar"
        plan = self.image.plan
        window = replace(plan.window, components=plan.window.whole)
        vectorial = replace(self.image, plan=replace(plan, window=window))
        image = image_through(self.optics, vectorial)
        yield self._entry("polarisation", image, method)

    def _solver(self) -> Iterator[BudgetEntry]:
        """Entries of pillar solver and proxy, against a solver with a tolerance
        30 times smaller.

        The complex ratio at ``SOLVED`` diameters is interpolated to every pillar,
        linearly in its logarithm.
        """
        lens = self.lens
        library = self.given.library
        diameters_um = np.linspace(*supercell.drawn_diameter_range(lens), SOLVED)
        tolerance = (library.sweep.bar if library else self.given.tolerance) / 30
        engine = workers.choose_engine(lens.cell)
        solve = workers.solve_to_tolerance(
            lens.cell, Incidence(lens.wavelength_um), tolerance=tolerance, engine=engine
        )
        precise = np.array([solve(diameter_um).t for diameter_um in diameters_um])
        modulus = lens.proxy.transmission(diameters_um, lens.wavelength_um)
        phase_rad = lens.proxy.phase_rad(diameters_um, lens.wavelength_um)
        proxy = modulus * np.exp(1j * phase_rad)
        method = f"{engine} solver at {tolerance:.0e}, {SOLVED} diameters"
        cases = [("pillar solver and proxy", precise / proxy, f"against the {method}")]
        if library is not None:
            stored = stored_response(library, diameters_um, lens.wavelength_um)
            cases = [
                ("pillar solver", precise / stored, f"library against the {method}"),
                ("proxy", stored / proxy, f"against the library, {SOLVED} diameters"),
            ]
        for link, ratio, description in cases:
            log_ratio = np.log(np.abs(ratio)) + 1j * np.unwrap(np.angle(ratio))
            designed_um = lens.diameters.diameter_um
            factor = np.exp(np.interp(designed_um, diameters_um, log_ratio))
            if self.coupling is not None:
                factor = factor * self.coupling
            yield self._changed(link, description, factor=factor)

    def _neighbours(self) -> Iterator[BudgetEntry]:
        """Entry of the local periodic approximation: rows of unequal pillars, solved as
        one cell.
        """
        if self.coupling is not None:
            method = (
                "rows of the lens file; what they leave open: budget of metalens psf"
            )
            yield BudgetEntry("neighbours", NONE, NONE, NONE, method)
            return
        try:
            rows_of = supercell.estimate_neighbour_coupling(self.lens)
        except CellError:
            return  # films or tilted walls: rows of those are not solved
        method = "rows of unequal pillars solved as one cell"
        yield self._changed("neighbours", method, factor=self._coupling(rows_of))

    def _mask(self) -> Iterator[BudgetEntry]:
        """Entry of rounding the diameters to the grid of the mask, with a mask."""
        if self.given.mask is None:
            return
        step_um = self.given.mask.diameter_step_nm * 1e-3
        designed = self.lens.diameters
        rounded = np.rint(designed.diameter_um / step_um) * step_um
        on_mask = replace(designed, diameter_um=rounded.astype(np.float32))
        lens = replace(self.lens, diameters=on_mask)
        drawn = MadeLens(lens, self.settings, response=self.made.response)
        method = f"every diameter rounded to {step_um * 1e3:g} nm"
        yield self._changed("mask grid", method, made=drawn)

    def _process(self) -> Iterator[BudgetEntry]:
        """Entry of the process spread, rms over draws; a fit of the built lens removes
        it.
        """
        if self.given.mask is None:
            return
        spread = self.given.mask.spread
        count = self.given.draws
        lenses = [(draw.state(), 0.0) for draw in draw_lenses(spread, count, seed=5)]
        method = f"{count} draws of the process, lens not measured"
        yield self._rms("process spread", lenses, method)

    def _calibration(self) -> Iterator[BudgetEntry]:
        """Entry of the uncertainty of an as-built fit: rms over draws of its posterior
        about its best estimate.
        """
        fitted = self.given.asbuilt
        if fitted is None:
            return
        check_lens(self.lens, fitted, insist=True)
        best = fitted.parameters()
        lenses = []
        for row in fitted.lens_samples(self.given.draws, seed=3):
            deviation = fitted.parameters(row) - best
            lenses.append(
                (process_state_of(deviation), float(deviation[PLACE["distance_um"]]))
            )
        method = f"{len(lenses)} draws of the fit's posterior against its best estimate"
        yield self._rms("calibration of the lens", lenses, method)

    def _rms(
        self, link: str, lenses: list[tuple[State, float]], method: str
    ) -> BudgetEntry:
        """Root mean square of the entries of (process state, sensor shift in um) pairs."""
        rows = [
            self._changed(link, method, state, shift_um=shift)
            for state, shift in lenses
        ]
        total, root = quadrature_total(rows), math.sqrt(len(rows))
        phase_rad, psf, gaze_rad = (
            value / root for value in (total.phase_rad, total.psf, total.gaze_rad)
        )
        return BudgetEntry(link, phase_rad, psf, gaze_rad, method)


def refuse_other_lens(lens: Lens, optics: OpticsConfig) -> None:
    """Refuse a network that was trained for a lens that differs by more than 2 %.

    Args:
        lens: lens to judge.
        optics: optics of the network's run.

    Raises:
        LensError: sensor distance, wavelength or aperture differ.
    """
    own = (
        lens.sensor_distance_um * 1e-3,
        lens.wavelength_um * 1e3,
        2e-3 * lens.diameters.radius_um,
    )
    of_run = optics.sensor_distance_mm, optics.wavelength_nm, optics.aperture_mm
    if any(abs(a - b) > 0.02 * b for a, b in zip(own, of_run, strict=True)):
        raise LensError(
            "the run's network was trained for another lens: sensor distance, wavelength, aperture are "
            f"{of_run[0]:g} mm, {of_run[1]:g} nm, {of_run[2]:g} mm there and {own[0]:g} mm, {own[1]:g} nm, {own[2]:g} mm in "
            "the lens file; give the lens.h5 of the run"
        )


def scatter_rad(changed: Array, base: Array) -> float:
    """Standard deviation in rad over pillars of the phase between two complex
    transmissions; a common phase is no error.

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
    """(*at_um) complex t of a pillar library at its nearest wavelength, mean of both
    polarisations.

    Modulus and unwrapped phase are interpolated linearly between its diameters.

    Args:
        library: the pillar library.
        at_um: diameters.
        wavelength_um: wavelength of the light.
    """
    nearest = int(np.argmin(np.abs(library.wavelength_um - wavelength_um)))
    t = library.t[:, 0, nearest].mean(0)
    polar = np.abs(t) + 1j * np.unwrap(np.angle(t))
    modulus_phase = np.interp(at_um, library.diameter_um, polar)
    return np.asarray(modulus_phase.real * np.exp(1j * modulus_phase.imag))
