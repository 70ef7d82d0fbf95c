"""The error budget of a lens: every link of the chain as phase, PSF and gaze error,
each with how it was found.

From the true pupil to the answer: :mod:`codesign.budget.reading`. From the pillars on,
a link is a change of the device
in the true image, carried through pillars, PSFs and images of rendered eyes, and read
by a run's network or, without
a run, by the linear estimator of :mod:`codesign.budget.task`. Nothing is added that was
not computed here or measured
in a file that is given.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from characterize.model import PLACE, process_state_of
from codesign.budget import task
from codesign.budget.entry import MEASURED, NONE, BudgetEntry, quadrature_total
from codesign.budget.person import subject_entries
from codesign.budget.prepared import PreparedDevice
from codesign.budget.response import interpolate_response, put_right, scatter_rad
from codesign.evaluate import AXIAL
from codesign.optics import psf_difference
from codesign.train import assess
from metalens.cell import Incidence
from metalens.core.arrays import Array
from metalens.core.errors import CellError, LensError, PropagationError, SceneError
from metalens.design import neighbours as supercell
from metalens.fabrication import State, biased, draws, sensitivity, transmission
from metalens.lens import NeighbourRows
from metalens.library import PillarLibrary, engines

SOLVED = 12  # diameters at which the pillar model is solved again
FINER = 30.0  # how much more precisely


def budget_entries(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """The budget, link by link from the answered gaze back to the pillars, ending with
    the sum.

    Raises:
        LensError: the as-built file is of another lens.
    """
    found: list[BudgetEntry] = []
    first = (oracle_answer_entry,) if about.reading is None else (_read,)
    parts = (
        *first,
        image_tolerance_entry,
        pillar_device_entry,
        solver_entries,
        neighbour_coupling_entry,
        mask_entry,
        process_entries,
        calibration_entry,
    )
    for part in (*parts, numerics_entries):
        for entry in part(about):
            found.append(entry)
            yield entry
    yield from measured_entry(about)
    yield quadrature_total(found)


def _read(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Of a run's network; later links are judged with the persons that these
    calibrate.
    """
    if about.reading is not None:
        yield from about.reading.path()


def oracle_answer_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """From the true pupil to the answer where no run was given: what no reader changes."""
    yield from subject_entries(about.given.frames, about.setting.rig)
    yield BudgetEntry("reader", NONE, NONE, NONE, "not known: no run was given (--run)")
    noise = (
        about.reader.noise_rad * math.sqrt(math.pi) / 2
    )  # rms to mean of a Gaussian in the plane
    yield BudgetEntry(
        "sensor noise",
        NONE,
        NONE,
        noise,
        "one frame: Cramér-Rao bound of the linear estimator",
    )
    said = "known to the estimator, switched off; not in the sum"
    here = about.device
    for link, optics in (("field", here.one_psf()), ("radiometry", here.evenly_lit())):
        yield replace(about.entry(link, optics, said), counted=False)
    if about.given.fwhm_nm:
        one, design_nm = (
            here.one_wavelength(about.lens.wavelength_um),
            1e3 * about.lens.wavelength_um,
        )
        said += f"; pillars answer as at {design_nm:g} nm, whatever their library holds"
        yield replace(about.entry("spectrum", one, said), counted=False)
    else:
        yield BudgetEntry("spectrum", NONE, 0.0, 0.0, "the light has one wavelength")


def image_tolerance_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """The tolerance of the image itself: one formed at a quarter of it."""
    link, tolerance = "image tolerance", about.image_tolerance
    said = f"image formed at {tolerance / assess.FINER:g} in place of {tolerance:g}"
    try:
        turn = about.turned_on_finer_image()
    except (SceneError, PropagationError) as problem:
        yield BudgetEntry(link, NONE, NONE, NONE, f"not known: {problem}")
        return
    yield BudgetEntry(link, NONE, NONE, turn, said)


def pillar_device_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Pillars in place of the smooth phase, films, both polarisations."""
    if about.reading is not None:
        said = (
            "pillars of the lens file in place of the run's smooth phase without films"
        )
        smooth = about.device.image(
            wave=about.reading.true.wave, layers=about.reading.true.layers
        )
        yield about.reading.changed(
            "pillars on a lattice", about.device.whole, smooth, said
        )
    films = about.lens.layers.films
    if films:
        bare = about.device.image(
            layers=replace(about.lens.layers, front=(), behind=())
        )
        yield about.entry(
            "glass", bare, f"{len(films)} films of the lens file taken away"
        )
    else:
        yield BudgetEntry("glass", NONE, 0.0, 0.0, "the lens file holds no film")
    said = "flux of both polarisations through the sensor in place of one scalar"
    yield about.entry("polarisation", about.device.both_polarisations(), said)


def measured_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """What the virtual experiment measures on the same frames."""
    if about.reading is None:
        return
    gaze = math.radians(about.reading.measured_deg[AXIAL])
    said = f"virtual experiment on these {about.given.frames.frames} frames, mean under axial slippage"
    yield BudgetEntry(MEASURED, NONE, NONE, gaze, said, counted=False)


def _changed(
    about: PreparedDevice, link: str, table: Array, method: str
) -> BudgetEntry:
    """The entry of other pillars: a table t(D) against the designed one."""
    turn = np.angle(table / about.aperture.designed())
    optics = about.device.image(wave=about.gathered(*about.aperture.maps(table)))
    return about.entry(
        link, optics, method, phase_rad=scatter_rad(turn, about.aperture.share)
    )


def solver_entries(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Solver and proxy, against the solver asked for thirty times the precision."""
    lens, given = about.lens, about.given
    low, high = supercell.printed(lens)
    at = np.linspace(low, high, SOLVED)
    tolerance = given.library.sweep.bar if given.library else given.tolerance
    engine = engines.choose_engine(lens.cell)
    solve = engines.solve_to_tolerance(
        lens.cell,
        Incidence(lens.wavelength_um),
        tolerance=tolerance / FINER,
        engine=engine,
    )
    exact = np.array([solve(float(d)).t for d in at])
    proxy = lens.proxy.transmission(at, lens.wavelength_um) * np.exp(
        1j * lens.proxy.phase_rad(at, lens.wavelength_um)
    )
    said = f"{engine} solver at {tolerance / FINER:.0e}, {SOLVED} diameters"
    designed, d = about.aperture.designed(), about.aperture.diameter_um
    if given.library is None:
        table = put_right(designed, d, at, exact / proxy)
        yield _changed(about, "pillar solver and proxy", table, f"against the {said}")
        return
    stored = _stored(given.library, at, lens.wavelength_um)
    solved, read = (
        put_right(designed, d, at, ratio) for ratio in (exact / stored, stored / proxy)
    )
    yield _changed(about, "pillar solver", solved, f"library against the {said}")
    yield _changed(about, "proxy", read, f"against the library, {SOLVED} diameters")


def _stored(library: PillarLibrary, at_um: Array, wavelength_um: float) -> Array:
    """t of the library at the nearest of its wavelengths, both polarisations averaged,
    between its diameters.
    """
    near = int(np.argmin(np.abs(library.wavelength_um - wavelength_um)))
    return interpolate_response(
        library.t[:, 0, near].mean(0), library.diameter_um, at_um
    )


def neighbour_coupling_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Local periodic approximation: rows of unlike pillars solved as one; what is open
    of them where the lens holds
    them."""
    held = about.lens.neighbours
    if held is not None:
        found = [
            other_rows_entry(about, other, "")
            for other in held.doubted(about.aperture.turn_sine())
        ]
        rms = [
            math.hypot(*column)
            for column in zip(
                *((e.phase_rad, e.psf, e.gaze_rad) for e in found), strict=True
            )
        ]
        said = "rows of the lens file, in the image: another truncation, a row left out, zones that get shorter"
        yield BudgetEntry("neighbours", rms[0], rms[1], rms[2], said)
        return
    try:
        rows = supercell.neighbours(about.lens)
    except CellError:
        return  # films or tilted walls: rows of those are not solved
    counts = (
        f"rows of {', '.join(map(str, row_lengths(rows, about.lens.cell.pitch_um)))}"
    )
    said = f"{counts} unlike pillars solved as one cell; factor carried over the aperture by the angle of turning"
    yield other_rows_entry(about, rows, said)


def row_lengths(rows: NeighbourRows, pitch_um: float) -> list[int]:
    """Pillars of every row along the lattice: it turns light by one wave over its
    length.
    """
    return [round(n) for n in rows.wavelength_um / rows.sine[~rows.diagonal] / pitch_um]


def other_rows_entry(
    about: PreparedDevice, rows: NeighbourRows, said: str
) -> BudgetEntry:
    """The entry of other rows than the lens holds."""
    built, sine = about.aperture.place >= 0, about.aperture.turn_sine()
    turn = np.angle(rows.mean(sine[built]))
    if about.lens.neighbours is not None:
        turn = turn - np.angle(about.lens.neighbours.mean(sine[built]))
    maps = about.aperture.maps(about.aperture.designed())
    optics = about.device.image(
        wave=about.gathered(*maps, lens=replace(about.lens, neighbours=rows))
    )
    return about.entry("neighbours", optics, said, phase_rad=float(turn.std()))


def mask_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Diameters as the mask holds them, where one is given."""
    if about.given.mask is None:
        return
    step = about.given.mask.diameter_step_nm
    table = about.aperture.rounded(about.aperture.designed(), step * 1e-3)
    yield _changed(about, "mask grid", table, f"every diameter rounded to {step:g} nm")


def process_entries(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Draws of the process; what a fit of the built lens would take out again."""
    if about.given.mask is None:
        return
    about.given.mask.spread.check(about.lens.cell)
    made = [
        FabricatedDevice(draw.state())
        for draw in draws(about.given.mask.spread, about.given.draws, seed=5)
    ]
    yield rms_over_lenses(
        about,
        "process spread",
        made,
        f"{len(made)} draws of the process, lens not measured",
    )


@dataclass(frozen=True, slots=True)
class FabricatedDevice:
    """A made lens on its sensor: its causes, and how far the distance is off. (A
    decentre moves the image alike.)
    """

    state: State
    shift_um: float = 0.0


def rms_over_lenses(
    about: PreparedDevice, link: str, lenses: list[FabricatedDevice], method: str
) -> BudgetEntry:
    """Root mean square over made lenses."""
    aperture, d = about.aperture, about.lens.diameters
    response = sensitivity(about.lens)
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    built = aperture.place >= 0
    base = aperture.maps(aperture.designed())[0][torch.from_numpy(built)].numpy()
    rows = []
    for made in lenses:
        answers = made.state.answers()
        table = transmission(
            about.lens.proxy,
            response,
            aperture.diameter_um,
            about.lens.wavelength_um,
            answers,
        )
        bias = made.state.bias_um(u, v)
        phase, level = aperture.maps(table, bias_um=bias)
        moved = biased(
            response,
            np.where(built, d.diameter_um, aperture.diameter_um[0]) + bias,
            bias,
        )
        if not isinstance(moved, float):
            phase = phase + torch.from_numpy(
                (np.angle(moved) * built).astype(np.float32)
            )
            level = level * torch.from_numpy(abs(moved).astype(np.float32))
        if made.state.bends():
            phase = phase + torch.from_numpy(
                made.state.phase_rad(u, v).astype(np.float32) * built
            )
        turn = phase[torch.from_numpy(built)].numpy() - base
        optics = about.device.image(
            wave=about.gathered(phase, level), shift_um=made.shift_um
        )
        found = about.entry(
            link,
            optics,
            method,
            phase_rad=scatter_rad(turn, np.full(turn.size, 1 / turn.size)),
        )
        rows.append((found.phase_rad, found.psf, found.gaze_rad))
    rms = [
        math.sqrt(sum(v * v for v in column) / len(rows))
        for column in zip(*rows, strict=True)
    ]
    return BudgetEntry(link, rms[0], rms[1], rms[2], method)


def calibration_entry(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """What the fit of the built lens leaves open: draws of its posterior against its
    best estimate.
    """
    fitted = about.given.asbuilt
    if fitted is None:
        return
    mine = about.lens.diameters.diameter_um
    if fitted.design.diameters.diameter_um.shape != mine.shape or not np.allclose(
        fitted.design.diameters.diameter_um, mine, atol=1e-6
    ):
        raise LensError(
            "the as-built file is of another lens than the one given; give the lens that was captured"
        )
    best = fitted.parameters()
    made = []
    for row in fitted.lens_samples(about.given.draws, seed=3):
        off = fitted.parameters(row) - best
        made.append(
            FabricatedDevice(process_state_of(off), float(off[PLACE["distance_um"]]))
        )
    said = (
        f"{len(made)} draws of the fit's posterior against its best estimate (pillars)"
    )
    yield rms_over_lenses(about, "calibration of the lens", made, said)


def numerics_entries(about: PreparedDevice) -> Iterator[BudgetEntry]:
    """Propagation, depths, wavelengths and kernels of the one-PSF engine, each at its
    setting, the rest at its finest.

    Read by the linear estimator, run or not: they are the settings of ``metalens psf``.
    """
    n = about.given.numerics
    cases = [
        (
            "propagation",
            {"psf_tolerance": n.psf_tolerance},
            f"tolerance {n.psf_tolerance:g}",
        ),
        ("depth sampling", {"depth_count": n.depth_count}, f"{n.depth_count} depths"),
        (
            "image kernels",
            {"basis_tolerance": n.basis_tolerance},
            f"tolerance {n.basis_tolerance:g}",
        ),
    ]
    if about.given.fwhm_nm:
        count = n.wavelength_count
        cases.insert(
            2,
            (
                "wavelength sampling",
                {"wavelength_count": count},
                f"{count} wavelengths",
            ),
        )
    finest = about.basis(about.finest)
    for link, change, said in cases:
        optics = about.basis(replace(about.finest, **change))  # type: ignore[arg-type]
        psf, gaze = (
            psf_difference(optics, finest, about.window),
            task.gaze_mean(about.shift(optics, finest)),
        )
        yield BudgetEntry(
            link,
            NONE,
            psf,
            gaze,
            f"{said} against the finest setting; linear estimator",
        )
