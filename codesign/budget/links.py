"""The error budget of a lens: every link of the chain as phase, PSF and gaze error, each with how it was found.

A link is a change of the optics that the chain believes in. It is carried through the pillars, the PSFs and the images
of rendered eyes, and read as gaze by the linear estimator of :mod:`codesign.budget.task`. Nothing is added that was not
computed here or measured in a file that is given.
"""

import math
from collections.abc import Iterator
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from characterize.inference import AsBuilt
from characterize.model import PLACE, state
from codesign.budget import task
from codesign.budget.journal import Journal
from codesign.budget.task import Linear, TaskSetting
from codesign.eye import face_axes
from codesign.optics import Aperture, Numerics, Window, kernels, psf_difference
from metalens.design import neighbours as supercell
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError, LensError
from metalens.image import PsfBasis
from metalens.lens import Lens
from metalens.made import Printed, State, draws, sensitivity, transmission
from metalens.pillars import Light, PillarLibrary, engines

SOLVED = 12  # diameters at which the pillar model is solved again
FINER = 30.0  # how much more precisely
NONE = math.nan


@dataclass(frozen=True, slots=True)
class Entry:
    """One link: rms phase error over the pillars (rad), relative L2 error of the PSFs, gaze error (rad, rms over eyes).

    nan where the link has none. method: how it was found.
    """

    link: str
    phase_rad: float
    psf: float
    gaze_rad: float
    method: str


@dataclass(frozen=True, slots=True)
class Given:
    """What is known beside the lens: each adds its entries.

    numerics: of the chain. fwhm_nm: of the diode. mask: of the PROCESS.toml. library: that the proxy was fitted to.
    asbuilt: of a fit. slip_mm: mean absolute error of a trained network along x, y, z. draws: of process and fit.
    """

    numerics: Numerics = field(default_factory=Numerics)
    fwhm_nm: float = 0.0
    mask: Printed | None = None
    library: PillarLibrary | None = None
    asbuilt: AsBuilt | None = None
    slip_mm: tuple[float, float, float] | None = None
    draws: int = 4
    tolerance: float = 1e-3


@dataclass(eq=False, slots=True)
class Bench:
    """The finest optics of the lens, the estimator that knows them, and what is compared with them."""

    lens: Lens
    given: Given
    setting: TaskSetting
    aperture: Aperture
    finest: Numerics
    window: Window
    eyes: task.Views
    reference: PsfBasis
    reader: Linear

    def basis(self, maps: tuple[torch.Tensor, torch.Tensor], numerics: Numerics, **moved: Any) -> PsfBasis:
        """Kernels of the lens with these pillar maps; ``moved``: shift_um, offset_um."""
        return kernels(self.lens, maps, numerics, self.window, fwhm_nm=self.given.fwhm_nm, **moved)

    def shift(self, optics: PsfBasis) -> torch.Tensor:
        """(scenes, unknowns) error of the answer to images through these optics."""
        return self.reader.shift(task.electrons(self.eyes.anchor, optics, self.setting))


def bench(lens: Lens, given: Given, setting: TaskSetting | None = None) -> Bench:
    """Render the eyes and compute the reference optics: twice the depths (64 at most), ten times the precision."""
    setting = replace(setting or TaskSetting(), sensor_distance_um=lens.sensor_distance_um)
    eyes, aperture, n = task.views(setting), Aperture(lens), given.numerics
    finest = Numerics(
        min(2 * n.depth_count, 64),
        n.wavelength_count + 6 if given.fwhm_nm else 1,
        min(n.psf_tolerance / 10, 1e-5),
        min(n.basis_tolerance / 10, 1e-4),
    )
    window = Window(*eyes.depths_um, setting.pitch_um)
    reference = kernels(lens, aperture.maps(aperture.designed()), finest, window, fwhm_nm=given.fwhm_nm)
    reader = task.linear(eyes, reference, setting)
    return Bench(lens, given, setting, aperture, finest, window, eyes, reference, reader)


def entries(about: Bench, journal: Journal | None = None) -> Iterator[Entry]:
    """The budget, link by link in the order of the chain, ending with the sum of squares.

    Args:
        journal: of the links that an interrupted run has done.

    Raises:
        LensError: the as-built file is of another lens.
    """
    journal, found = journal or Journal(), list[Entry]()
    for part in (_pillars, _neighbours, _mask, _spread, _calibration, _numerics, _network):
        done = journal.part(part.__name__, lambda part=part: [astuple(entry) for entry in part(about)])  # type: ignore[misc]
        links = [Entry(*values) for values in done]
        found += links
        yield from links
    yield _total(found)


def _total(found: list[Entry]) -> Entry:
    def together(name: str) -> float:
        return math.sqrt(sum(getattr(e, name) ** 2 for e in found if math.isfinite(getattr(e, name))))

    return Entry(
        "all links", together("phase_rad"), together("psf"), together("gaze_rad"), "root of the sum of squares"
    )


def _changed(about: Bench, link: str, table: Array, method: str) -> Entry:
    """The entry of other pillars: a table t(D) against the designed one."""
    turn = np.angle(table / about.aperture.designed())
    optics = about.basis(about.aperture.maps(table), about.finest)
    return _entry(about, link, (_spread_of(turn, about.aperture.share), optics), method)


def _entry(about: Bench, link: str, found: tuple[float, PsfBasis], method: str) -> Entry:
    phase, optics = found
    psf = psf_difference(optics, about.reference, about.window)
    return Entry(link, phase, psf, task.gaze_rms(about.shift(optics)), method)


def _spread_of(turn_rad: Array, share: Array) -> float:
    """Standard deviation of a phase over the pillars: a common phase is no error."""
    mean = np.angle((np.exp(1j * turn_rad) * share).sum())
    off = np.angle(np.exp(1j * (turn_rad - mean)))
    return float(np.sqrt((off**2 * share).sum()))


def _pillars(about: Bench) -> Iterator[Entry]:
    """Solver and proxy, against the solver asked for thirty times the precision."""
    lens, given = about.lens, about.given
    low, high = supercell.printed(lens)
    at = np.linspace(low, high, SOLVED)
    tolerance = given.library.sweep.tolerance if given.library else given.tolerance
    engine = engines.choose(lens.cell)
    solve = engines.precise(lens.cell, Light(lens.wavelength_um), tolerance=tolerance / FINER, engine=engine)
    exact = np.array([solve(float(d)).t for d in at])
    proxy = lens.proxy.transmission(at, lens.wavelength_um) * np.exp(1j * lens.proxy.phase_rad(at, lens.wavelength_um))
    said = f"{engine} solver at {tolerance / FINER:.0e}, {SOLVED} diameters"
    if given.library is None:
        yield _changed(about, "pillar solver and proxy", _carried(about, at, exact / proxy), f"against the {said}")
        return
    stored = _stored(given.library, at, lens.wavelength_um)
    yield _changed(about, "pillar solver", _carried(about, at, exact / stored), f"library against the {said}")
    yield _changed(about, "proxy", _carried(about, at, stored / proxy), f"against the library, {SOLVED} diameters")


def _carried(about: Bench, at_um: Array, ratio: Array) -> Array:
    """The designed table times a ratio that is known at some diameters."""
    log = np.log(np.abs(ratio)) + 1j * np.unwrap(np.angle(ratio))
    d = about.aperture.diameter_um
    return np.asarray(
        about.aperture.designed() * np.exp(np.interp(d, at_um, log.real) + 1j * np.interp(d, at_um, log.imag))
    )


def _stored(library: PillarLibrary, at_um: Array, wavelength_um: float) -> Array:
    """t of the library's entries between its diameters, both polarisations averaged."""
    near = int(np.argmin(np.abs(library.wavelength_um - wavelength_um)))
    t = library.t[:, 0, near].mean(0)
    phase, level = np.unwrap(np.angle(t)), np.abs(t)
    d = library.diameter_um
    return np.asarray(np.interp(at_um, d, level) * np.exp(1j * np.interp(at_um, d, phase)))


def _neighbours(about: Bench) -> Iterator[Entry]:
    """Local periodic approximation: rows of unlike pillars solved as one."""
    try:
        found = supercell.neighbours(about.lens)
    except CellError:
        return  # films or tilted walls: rows of those are not solved
    factor = found.at(about.aperture.turn_sine())
    phase, level = about.aperture.maps(about.aperture.designed())
    maps = (
        phase + torch.from_numpy(np.angle(factor).astype(np.float32)),
        level * torch.from_numpy(np.abs(factor).astype(np.float32)),
    )
    built = about.aperture.place >= 0
    turn = np.angle(factor[built])
    counts = (
        f"rows of {', '.join(str(round(about.lens.wavelength_um / s / about.lens.cell.pitch_um)) for s in found.sine)}"
    )
    said = f"{counts} unlike pillars solved as one cell; factor carried over the aperture by the angle of turning"
    yield _entry(
        about,
        "local periodic approximation",
        (float(turn.std()), about.basis((maps[0] * torch.from_numpy(built), maps[1]), about.finest)),
        said,
    )


def _mask(about: Bench) -> Iterator[Entry]:
    if about.given.mask is None:
        return
    step = about.given.mask.diameter_step_nm
    table = about.aperture.rounded(about.aperture.designed(), step * 1e-3)
    yield _changed(about, "mask grid", table, f"every diameter rounded to {step:g} nm")


def _spread(about: Bench) -> Iterator[Entry]:
    """Draws of the process; what a fit of the built lens would take out again."""
    if about.given.mask is None:
        return
    made = [Made(draw.state()) for draw in draws(about.given.mask.spread, about.given.draws, seed=5)]
    yield _drawn(about, "process spread", made, f"{len(made)} draws of the process, lens not measured")


@dataclass(frozen=True, slots=True)
class Made:
    """A made lens on its sensor: its causes, and how far distance and window are off."""

    state: State
    shift_um: float = 0.0
    offset_um: tuple[float, float] = (0.0, 0.0)


def _drawn(about: Bench, link: str, lenses: list[Made], method: str) -> Entry:
    """Root mean square over made lenses."""
    aperture, d = about.aperture, about.lens.diameters
    response = sensitivity(about.lens)
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    built = aperture.place >= 0
    base = aperture.maps(aperture.designed())[0][torch.from_numpy(built)].numpy()
    rows = []
    for made in lenses:
        answers = made.state.answers()
        table = transmission(about.lens.proxy, response, aperture.diameter_um, about.lens.wavelength_um, answers)
        phase, level = aperture.maps(table, bias_um=made.state.bias_um(u, v))
        if made.state.bends():
            phase = phase + torch.from_numpy(made.state.phase_rad(u, v).astype(np.float32) * built)
        turn = phase[torch.from_numpy(built)].numpy() - base
        optics = about.basis((phase, level), about.finest, shift_um=made.shift_um, offset_um=made.offset_um)
        flat = np.full(turn.size, 1 / turn.size)
        psf = psf_difference(optics, about.reference, about.window)
        rows.append((_spread_of(turn, flat), psf, task.gaze_rms(about.shift(optics))))
    rms = [math.sqrt(sum(v * v for v in column) / len(rows)) for column in zip(*rows, strict=True)]
    return Entry(link, rms[0], rms[1], rms[2], method)


def _calibration(about: Bench) -> Iterator[Entry]:
    """What the fit of the built lens leaves open: draws of its posterior against its best estimate."""
    fitted = about.given.asbuilt
    if fitted is None:
        return
    mine = about.lens.diameters.diameter_um
    if fitted.design.diameters.diameter_um.shape != mine.shape or not np.allclose(
        fitted.design.diameters.diameter_um, mine, atol=1e-6
    ):
        raise LensError("the as-built file is of another lens than the one given; give the lens that was captured")
    best = fitted.parameters()
    made = []
    for row in fitted.samples(about.given.draws, seed=3):
        off = fitted.parameters(row) - best
        shift, *offset = (float(off[PLACE[name]]) for name in ("distance_um", "decentre_x_um", "decentre_y_um"))
        made.append(Made(state(off), shift, (offset[0], offset[1])))
    said = f"{len(made)} draws of the fit's posterior against its best estimate (pillars)"
    yield _drawn(about, "calibration uncertainty", made, said)


def _numerics(about: Bench) -> Iterator[Entry]:
    """Propagation, depths, wavelengths and kernels: each at its setting, the rest at its finest."""
    maps, n = about.aperture.maps(about.aperture.designed()), about.given.numerics
    cases = [
        ("propagation", {"psf_tolerance": n.psf_tolerance}, f"tolerance {n.psf_tolerance:g}"),
        ("depth sampling", {"depth_count": n.depth_count}, f"{n.depth_count} depths"),
        ("image kernels", {"basis_tolerance": n.basis_tolerance}, f"tolerance {n.basis_tolerance:g}"),
    ]
    if about.given.fwhm_nm:
        count = n.wavelength_count
        cases.insert(2, ("wavelength sampling", {"wavelength_count": count}, f"{count} wavelengths"))
    for link, change, said in cases:
        optics = about.basis(maps, replace(about.finest, **change))  # type: ignore[arg-type]
        yield _entry(about, link, (NONE, optics), f"{said} against the finest setting")
    noise = about.reader.noise_rad
    yield Entry(
        "sensor noise", NONE, NONE, noise, "one frame: Cramér-Rao bound of the linear estimator, subject unknown"
    )


def _network(about: Bench) -> Iterator[Entry]:
    """A trained network's slippage error as gaze, through the spherical eye."""
    if about.given.slip_mm is None:
        return
    from codesign.gaze import mean_geometry, optical_axis, pupil_of

    rig = about.setting.rig
    geometry = mean_geometry(rig)
    random = torch.Generator().manual_seed(1)
    turn = (torch.rand(256, 2, generator=random, dtype=torch.float64) - 0.5) * torch.tensor([0.6, 0.45])
    right, down, out = face_axes(rig.elevation_rad)
    looks = torch.sin(turn[:, :1]) * right + torch.sin(turn[:, 1:]) * down + out
    looks = looks / looks.norm(dim=1, keepdim=True)
    slip = torch.zeros(256, 3, dtype=torch.float64)
    sigma = torch.tensor(about.given.slip_mm, dtype=torch.float64) * math.sqrt(math.pi / 2)  # of a mean absolute error
    wrong = torch.randn(256, 3, generator=random, dtype=torch.float64) * sigma
    seen = optical_axis(pupil_of(looks, slip, geometry), wrong, geometry).direction
    gaze = float(torch.arccos((seen * looks).sum(1).clamp(-1, 1)).pow(2).mean().sqrt())
    said = "slippage error of the trained run, through the spherical eye, no personal calibration"
    yield Entry("network", NONE, NONE, gaze, said)
