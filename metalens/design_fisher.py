"""Free-form phases that carry depth: the axial information of Eq. 11, measured honestly, at a bounded spread of light.

The phase is a cubic spline on a control grid that is refined in stages (coarse to fine), on top of a hyperbolic
focus or of a double helix, whose vortices no smooth phase can grow. Adam climbs the information over the
depths, at random sub-pixel positions each step, so that nothing can be gained from one position; a growing penalty
holds the encircled energy, and the best iterate that keeps it at every depth, judged on the honest average, is
returned. Several starts, all reported.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from metalens import pupil as pupils
from metalens.design import PhaseOf
from metalens.design_fisher_settings import SAMPLE_UM, Fisher
from metalens.errors import ConfigError
from metalens.fisher import axial_information, encircled_energy, pixel_information
from metalens.profiles import Focus, hyperbolic
from metalens.pupil import Pupil
from metalens.store import Array

Tensor = torch.Tensor
STEP_UM = 200.0  # of the difference in Eq. 11
WINDOW_UM = 144.0


@dataclass(frozen=True, eq=False, slots=True)
class Score:
    """Honest figures of a phase on the quick pupil model.

    information: (depths,) I(z) per mm², averaged over sub-pixel positions.
    encircled: (depths,) share of the light through the aperture inside the radius.
    """

    information: Tensor
    encircled: Tensor


@dataclass(frozen=True, eq=False, slots=True)
class FisherPhase:
    """A designed phase.

    controls: (n, n) spline coefficients in rad. focus_um: source distance of the hyperbolic part.
    zones: rings of the double helix below, 0 for none.
    score: of this phase. starts: (information, least encircled energy) that each start reached.
    converged: whether the encircled energy is kept at every depth. reason: in words.
    """

    controls: Tensor
    focus_um: float
    zones: int
    score: Score
    starts: tuple[tuple[float, float], ...]
    converged: bool
    reason: str


def fisher_profile(focus: Focus, *, radius_um: float, settings: Fisher | None = None) -> tuple[PhaseOf, FisherPhase]:
    """The whole lens phase (focus and free form) as a function of position, and how it was found.

    ``focus.source_distance_um`` is not used: the settings choose the focus.
    """
    settings = settings or Fisher()
    pupil = Pupil(radius_um, focus.sensor_distance_um, focus.wavelength_um, nodes=_nodes(radius_um, focus))
    found = optimise(pupil, settings)
    base = Focus(focus.wavelength_um, focus.sensor_distance_um, found.focus_um)
    controls = found.controls.numpy()

    def phase(x_um: Array, y_um: Array) -> Array:
        across, down = (spline(a / radius_um, len(controls)) for a in (x_um, y_um))
        smooth = hyperbolic(x_um, y_um[:, None], base) + down @ controls @ across.T
        return np.asarray(smooth + vortices(x_um, y_um[:, None], radius_um=radius_um, zones=found.zones))

    return phase, found


def optimise(pupil: Pupil, settings: Fisher) -> FisherPhase:
    """Best of several starts; deterministic for a seed."""
    best: FisherPhase | None = None
    reached = []
    for start in range(settings.starts):
        share = (start + 0.5) / settings.starts
        focus = 1e3 * (settings.focus_mm[0] + share * (settings.focus_mm[1] - settings.focus_mm[0]))
        generator = torch.Generator().manual_seed(1000 * settings.seed + start)
        made = _climb(pupil, settings, focus, settings.zones[start % len(settings.zones)], generator)
        information, least = float(made.score.information.mean()), float(made.score.encircled.min())
        reached.append((information, least))
        if best is None or (made.converged, information) > (best.converged, float(best.score.information.mean())):
            best = made
    if best is None:
        raise ConfigError("no start was tried")
    return replace(best, starts=tuple(reached))


def score(phase_rad: Tensor, pupil: Pupil, *, focus_um: float, settings: Fisher, depths: int = 11) -> Score:
    """Information and encircled energy of a phase on the pupil's nodes, at ``depths`` depths of the range."""
    near, far = _stacks(phase_rad, pupil, focus_um, _depths(settings, depths))
    value = axial_information(
        near,
        far,
        step_um=STEP_UM,
        sample_um=SAMPLE_UM,
        pixel_um=settings.pixel_um,
        normalisation=settings.normalisation,
    )
    return Score(value.detach(), encircled_energy(near, SAMPLE_UM, radius_um=settings.radius_um).detach())


def vortices(x_um: Array, y_um: Array, *, radius_um: float, zones: int) -> Array:
    """Phase of a double helix without its focus: ring l of equal areas carries the charge 2l - 1; 0 for no zones."""
    if zones == 0:
        return np.zeros(np.broadcast_shapes(x_um.shape, y_um.shape))
    ring = np.clip(np.ceil(zones * (x_um**2 + y_um**2) / radius_um**2), 1, zones)
    return np.asarray((2 * ring - 1) * np.arctan2(y_um, x_um))


def spline(position: Array, count: int) -> Array:
    """(n, count) cubic B-spline weights of positions in [-1, 1] (held at the ends), uniform knots."""
    place = (np.clip(position, -1, 1) + 1) / 2 * (count - 3)
    first = np.clip(np.floor(place).astype(int), 0, count - 4)
    t = place - first
    parts = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    weights = np.zeros((len(position), count))
    for k, part in enumerate(parts):
        weights[np.arange(len(position)), first + k] = part / 6
    return weights


def _climb(pupil: Pupil, settings: Fisher, focus_um: float, zones: int, generator: torch.Generator) -> FisherPhase:
    spread = settings.spread_rad * (0.1 if zones else 1.0)
    controls = spread * torch.randn(settings.grids[0], settings.grids[0], generator=generator, dtype=torch.float64)
    best: tuple[tuple[bool, float], Tensor, Score] | None = None
    for stage, grid in enumerate(settings.grids):
        if len(controls) != grid:
            controls = _refined(controls, grid)
        build = _Phase(pupil, grid, zones)
        controls.requires_grad_(True)
        step = torch.optim.Adam([controls], lr=0.12)
        for i in range(settings.iterations):
            for group in step.param_groups:
                group["lr"] = 0.12 * (0.5 + 0.5 * math.cos(math.pi * i / settings.iterations)) + 0.004
            hold = 10.0 * (1 + 2 * (stage * settings.iterations + i) / (settings.iterations * len(settings.grids)))
            loss = _loss(build(controls), pupil, settings, focus_um, hold, generator)
            step.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            step.step()
            last = i == settings.iterations - 1
            if last or (stage == len(settings.grids) - 1 and i % 10 == 9):
                seen = score(build(controls.detach()), pupil, focus_um=focus_um, settings=settings)
                kept = bool(seen.encircled.min() >= settings.encircled - 1e-3)
                rank = (kept, float(seen.information.mean()))
                if best is None or rank > best[0]:
                    best = (rank, controls.detach().clone(), seen)
        controls = controls.detach()
    if best is None:
        raise ConfigError("no iterate was judged")
    reason = "encircled energy kept at every depth" if best[0][0] else "encircled energy missed: raise iterations"
    return FisherPhase(best[1], focus_um, zones, best[2], (), best[0][0], reason)


def _loss(
    phase: Tensor, pupil: Pupil, settings: Fisher, focus_um: float, hold: float, generator: torch.Generator
) -> Tensor:
    """Minus the log information at jittered depths and two random positions, plus the energy that is missing."""
    jitter = 1e3 * (settings.depths_mm[1] - settings.depths_mm[0]) / 12
    depths = _depths(settings, 7) + jitter * (torch.rand(7, generator=generator, dtype=torch.float64) - 0.5)
    near, far = _stacks(phase, pupil, focus_um, depths)
    total = phase.new_zeros(())
    for _ in range(2):
        y, x = ((torch.rand(2, generator=generator) - 0.5) * settings.pixel_um).tolist()
        value = pixel_information(
            near,
            far,
            step_um=STEP_UM,
            sample_um=SAMPLE_UM,
            pixel_um=settings.pixel_um,
            normalisation=settings.normalisation,
            shift_um=(y, x),
        )
        spread, mean = torch.log(value + 1e-4).mean(), torch.log(value.mean() + 1e-4)
        total = total - (settings.even * spread + (1 - settings.even) * mean) / 2
    energy = encircled_energy(near, SAMPLE_UM, radius_um=settings.radius_um)
    missing = torch.relu(settings.encircled + 0.01 - energy)
    return total + hold * missing.mean() + 10 * hold * (missing**2).mean()


def _stacks(phase: Tensor, pupil: Pupil, focus_um: float, depths_um: Tensor) -> tuple[Tensor, Tensor]:
    samples = int(min(WINDOW_UM, pupil.period_um) / SAMPLE_UM)
    both = torch.cat([depths_um, depths_um + STEP_UM])
    stack = pupils.psf(phase, pupil, depths_um=both, focus_um=focus_um, sample_um=SAMPLE_UM, samples=samples)
    return stack[: len(depths_um)], stack[len(depths_um) :]


def _depths(settings: Fisher, count: int) -> Tensor:
    low, high = (1e3 * d for d in settings.depths_mm)
    return torch.linspace(low, high, count, dtype=torch.float64)


def _nodes(radius_um: float, focus: Focus) -> int:
    """Enough nodes that the PSF's period is 1.9 windows, in whole blocks of 16."""
    edge = Pupil(radius_um, focus.sensor_distance_um, focus.wavelength_um).edge
    return max(64, 16 * math.ceil(1.9 * WINDOW_UM * 2 * edge / focus.wavelength_um / 16))


class _Phase:
    """Spline coefficients to the phase on the pupil's nodes, a sparse product."""

    def __init__(self, pupil: Pupil, grid: int, zones: int) -> None:
        px, py = (a.numpy() for a in pupils.coordinates(pupil))
        self.base = torch.from_numpy(vortices(px, py, radius_um=pupil.radius_um, zones=zones))
        x, y = px.ravel() / pupil.radius_um, py.ravel() / pupil.radius_um
        across, down = spline(x, grid), spline(y, grid)
        rows, columns, values = [], [], []
        for k in range(len(x)):
            i, j = np.nonzero(down[k])[0], np.nonzero(across[k])[0]
            rows.append(np.full(len(i) * len(j), k))
            columns.append((i[:, None] * grid + j).ravel())
            values.append((down[k, i][:, None] * across[k, j]).ravel())
        index = torch.from_numpy(np.stack([np.concatenate(rows), np.concatenate(columns)]))
        entries = torch.from_numpy(np.concatenate(values))
        self.matrix = torch.sparse_coo_tensor(index, entries, (len(x), grid * grid), check_invariants=True)

    def __call__(self, controls: Tensor) -> Tensor:
        phase: Tensor = torch.sparse.mm(self.matrix, controls.reshape(-1, 1)).reshape(self.base.shape)
        return self.base + phase


def _refined(controls: Tensor, grid: int) -> Tensor:
    """The same phase on a finer control grid, in the sense of least squares."""
    place = np.linspace(-1, 1, 4 * grid)
    coarse, fine = spline(place, len(controls)), spline(place, grid)
    change = torch.from_numpy(np.linalg.lstsq(fine, coarse, rcond=None)[0])
    return change @ controls @ change.mT
