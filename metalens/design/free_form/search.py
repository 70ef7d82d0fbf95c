"""Free-form phases that carry depth: gradient ascent of the Fisher information (paper
Eq. 11) at a bounded spread of light, coarse to fine.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.design import Focus, PhaseOf, hyperbolic_phase, vortex_phase
from metalens.design.free_form.settings import FisherSettings, ResolvedFisherSettings
from metalens.image import (
    Field,
    Pupil,
    axial_information,
    encircled_energy,
    pixel_information,
)
from metalens.image import pupil as pupils

RATE = 0.15  # first step of Adam, rad
NODE_RATE = 0.5  # the same on free nodes: large steps leave poor optima
NODES_WEIGHT = 160  # size of a stage on the nodes, for its share of the iterations
CHECKS = 20  # iterations between two evaluations of the deterministic figures
CLIMB_IMAGES = 4  # images of a gradient step, at least two for every field angle
DIRECTIONS = 4  # azimuths of the field from which the steps draw


@dataclass(frozen=True, eq=False, slots=True)
class DesignScore:
    """Figures of a phase on the quick pupil model.

    information: (depths,), with several field angles (angles, depths), I(z) per mm²
        averaged over sub-pixel positions.
    encircled: of the same shape, share of the light
        through the aperture in the radius.
    """

    information: Tensor
    encircled: Tensor


class AxialObjective:
    """Minus the log of the axial information I(z), averaged over depths and pixel
    positions.

    The mean is over random depths, azimuths of the field and positions of the pixel
    grid; every field angle has the same weight.
    """

    def __init__(self, pupil: Pupil, settings: ResolvedFisherSettings) -> None:
        self.pupil, self.settings = pupil, settings

    def loss(
        self, phase_rad: Tensor, focus_um: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Loss and encircled energy at some depths, see :class:`AxialObjective`.

        With e = ``settings.even``: -mean over positions of e mean(log I) + (1 - e)
        log(mean I), I per mm² of the images, the means over depths.

        Args:
            phase_rad: (nodes, nodes) phase without its focus, rad.
            focus_um: source distance of the hyperbolic part, um.
            generator: of random depths, fields and positions.
        """
        settings = self.settings
        depths, fields, positions = self._sample_views(generator)
        near, far = _stacks(
            phase_rad,
            self.pupil,
            focus_um,
            depths,
            fields,
            settings,
            settings.climb_window_um,
        )
        total = phase_rad.new_zeros(())
        options = _information_options(settings)
        for y, x in (positions * settings.pixel_um).tolist():
            value = pixel_information(near, far, shift_um=(y, x), **options)
            value = value.reshape(-1, len(settings.angles_deg))
            mean_log = torch.log(value + 1e-4).mean()
            log_mean = torch.log(value.mean(0) + 1e-4).mean()
            gain = settings.even * mean_log + (1 - settings.even) * log_mean
            total = total - gain / len(positions)
        energy = encircled_energy(
            near, settings.sample_um, radius_um=settings.radius_um
        )
        return total, energy

    def _sample_views(
        self, generator: torch.Generator
    ) -> tuple[Tensor, list[Field], Tensor]:
        """Source depths, fields and pixel positions of one step.

        Depths are stratified over the range, azimuths are multiples of 90 degrees.

        Returns:
            (images,) depths in um, as many fields with the angles in turn, and (2, 2)
            positions (y, x) of the pixel grid in pixels.
        """
        angles = self.settings.angles_deg
        low, high = (1e3 * d for d in self.settings.depths_mm)
        count = max(2, math.ceil(CLIMB_IMAGES / len(angles))) * len(angles)
        strata = torch.randperm(count, generator=generator) + torch.rand(
            count, generator=generator
        )
        depths = low + (high - low) / count * strata.double()
        turns = torch.randint(0, DIRECTIONS, (count,), generator=generator).tolist()
        fields = [
            _field(angles[i % len(angles)], turn / DIRECTIONS)
            for i, turn in enumerate(turns)
        ]
        return depths, fields, torch.rand(2, 2, generator=generator) - 0.5

    def judge(self, phase_rad: Tensor, focus_um: float) -> DesignScore:
        """See :class:`AxialObjective`."""
        return score_phase(
            phase_rad, self.pupil, focus_um=focus_um, settings=self.settings
        )


def score_phase(
    phase_rad: Tensor,
    pupil: Pupil,
    *,
    focus_um: float,
    settings: ResolvedFisherSettings,
    depths: int = 11,
) -> DesignScore:
    """Axial information (per mm²) and encircled energy of a phase over the depth range.

    Off axis, mean information and least energy of the azimuths +x and +y. The figures
    have shape (depths,), with several field angles (angles, depths).

    Args:
        phase_rad: (nodes, nodes) phase on the pupil without its focus, rad.
        pupil: sampled pupil of the lens.
        focus_um: source distance in focus, um.
        settings: resolved settings of the design.
        depths: number of even depths over ``settings.depths_mm``.
    """
    low, high = (1e3 * d for d in settings.depths_mm)
    depths_um = torch.linspace(low, high, depths, dtype=torch.float64)
    phase = phase_rad.detach()
    width = settings.window_um
    options = _information_options(settings)
    values, energies = [], []
    for angle in settings.angles_deg:
        information, encircled = [], []
        for turn in (0.0, 0.25) if angle > 0 else (0.0,):
            fields = [_field(angle, turn)] * depths
            near, far = _stacks(
                phase, pupil, focus_um, depths_um, fields, settings, width
            )
            information.append(axial_information(near, far, **options))
            encircled.append(
                encircled_energy(near, settings.sample_um, radius_um=settings.radius_um)
            )
        values.append(torch.stack(information).mean(0))
        energies.append(torch.stack(encircled).amin(0))
    if len(values) == 1:
        return DesignScore(values[0], energies[0])
    return DesignScore(torch.stack(values), torch.stack(energies))


def _information_options(settings: ResolvedFisherSettings) -> dict[str, Any]:
    """Arguments of the information of Eq. 11: lengths in um, and the normalisation."""
    return {"step_um": settings.step_um, "sample_um": settings.sample_um, "pixel_um": settings.pixel_um,
            "normalisation": settings.normalisation}  # fmt: skip


def _field(angle_deg: float, turn: float) -> Field:
    """Field at an angle in degrees and an azimuth in turns (0 on the axis)."""
    return Field(math.radians(angle_deg), 2 * math.pi * turn if angle_deg > 0 else 0.0)


def _stacks(
    phase_rad: Tensor,
    pupil: Pupil,
    focus_um: float,
    depths_um: Tensor,
    fields: list[Field],
    settings: ResolvedFisherSettings,
    window_um: float,
) -> tuple[Tensor, Tensor]:
    """PSFs (n, y, x) at source depths, and at depths larger by ``settings.step_um``.

    Args:
        phase_rad: (nodes, nodes) phase on the pupil without its focus, rad.
        pupil: sampled pupil of the lens.
        focus_um: source distance in focus, um.
        depths_um: (n,) source depths, um.
        fields: field of every depth.
        settings: resolved settings of the design.
        window_um: width of the PSFs, at most the period of the pupil's grid.
    """
    sample = settings.sample_um
    samples = int(min(window_um, pupil.period_um) / sample)
    both = torch.cat([depths_um, depths_um + settings.step_um])
    stack = pupils.psf(phase_rad, pupil, depths_um=both, fields=fields * 2, focus_um=focus_um, sample_um=sample,
                       samples=samples)  # fmt: skip
    return stack[: len(depths_um)], stack[len(depths_um) :]


@dataclass(frozen=True, eq=False, slots=True)
class FisherPhase:
    """A designed free-form phase.

    controls: (n, n) spline coefficients in rad, or with ``cells`` the phase of every
        node of the pupil.
    focus_um: source distance of the hyperbolic part.
    zones: rings of the double helix below, 0 for none.
    cells: whether the controls are one value for every node.
    score: of this phase.
    converged: whether the encircled energy is kept at every depth.
    starts: (information, least encircled energy) of each start.
    """

    controls: Tensor
    focus_um: float
    zones: int
    cells: bool
    score: DesignScore
    converged: bool
    starts: tuple[tuple[float, float], ...] = ()

    @property
    def rank(self) -> tuple[bool, float]:
        """Sort key of designs: encircled energy kept, then mean information."""
        return self.converged, float(self.score.information.mean())

    @property
    def reason(self) -> str:
        """Whether the encircled energy is kept, in words."""
        if self.converged:
            return "encircled energy kept at every depth"
        return "encircled energy missed: raise iterations"


def fisher_profile(
    focus: Focus, *, radius_um: float, settings: FisherSettings | None = None
) -> tuple[PhaseOf, FisherPhase]:
    """The whole lens phase in rad, focus and free form, as a function of position.

    phase(x, y) = hyperbolic phase + free form + vortices of the double helix.

    Args:
        focus: source and sensor distances; its source distance is used where the
            settings leave depths and foci to the lens.
        radius_um: radius of the aperture, um.
        settings: of the search; None for the defaults.

    Returns:
        The phase of x (columns,) and y (rows,) in um, and the designed phase.
    """
    resolved = (settings or FisherSettings()).about(focus, radius_um)
    pupil = design_pupil(focus, radius_um, resolved)
    design = optimize_free_form(pupil, resolved)
    base = replace(focus, source_distance_um=design.focus_um)
    extra = free_form(design.controls.numpy(), pupil, cells=design.cells)

    def phase(x_um: Array, y_um: Array) -> Array:
        smooth = hyperbolic_phase(x_um, y_um[:, None], base) + extra(x_um, y_um)
        return np.asarray(
            smooth
            + vortex_phase(x_um, y_um[:, None], radius_um=radius_um, zones=design.zones)
        )

    return phase, design


def free_form(controls: Array, pupil: Pupil, *, cells: bool = False) -> PhaseOf:
    """The free-form phase in rad as a function of x and y in um.

    Args:
        controls: (n, n) B-spline coefficients over the aperture, rad; with ``cells``
            the phase of every node of the pupil, which the nearest node gives.
        pupil: sampled pupil of the lens, its nodes even in direction cosine.
        cells: whether the controls are one value for every node.
    """

    def smooth(x_um: Array, y_um: Array) -> Array:
        across, down = (
            bspline_weights(a / pupil.radius_um, len(controls)) for a in (x_um, y_um)
        )
        return np.asarray(down @ controls @ across.T)

    def stepped(x_um: Array, y_um: Array) -> Array:
        path = np.sqrt(x_um**2 + y_um[:, None] ** 2 + pupil.sensor_distance_um**2)
        scale = pupil.nodes / (2 * pupil.edge)
        middle = (pupil.nodes - 1) / 2
        last = pupil.nodes - 1
        row, column = (
            np.clip(np.rint(a / path * scale + middle), 0, last).astype(np.intp)
            for a in (y_um[:, None], x_um)
        )
        return np.asarray(controls[row, column])

    return stepped if cells else smooth


def design_pupil(
    focus: Focus, radius_um: float, settings: ResolvedFisherSettings
) -> Pupil:
    """Enough nodes that the PSF's period is 1.9 windows, in whole blocks of 16.

    Args:
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
        settings: resolved settings of the design.
    """
    edge = Pupil(radius_um, focus.sensor_distance_um, focus.wavelength_um).edge
    nodes = max(
        64,
        16 * math.ceil(1.9 * settings.window_um * 2 * edge / focus.wavelength_um / 16),
    )
    return Pupil(radius_um, focus.sensor_distance_um, focus.wavelength_um, nodes)


def optimize_free_form(pupil: Pupil, settings: ResolvedFisherSettings) -> FisherPhase:
    """Free-form phase of most information: the best of several starts of gradient
    ascent.

    Starts that keep the encircled energy come before all others. The starts' foci are
    spread evenly over ``settings.focus_mm``. Deterministic for a seed.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
    """
    objective = AxialObjective(pupil, settings)
    results = []
    for start in range(settings.starts):
        share = (start + 0.5) / settings.starts
        focus = 1e3 * (
            settings.focus_mm[0] + share * (settings.focus_mm[1] - settings.focus_mm[0])
        )
        generator = torch.Generator().manual_seed(1000 * settings.seed + start)
        zones = settings.zones[start % len(settings.zones)]
        results.append(_climb(pupil, settings, objective, focus, zones, generator))
    starts = tuple((r.rank[1], float(r.score.encircled.min())) for r in results)
    return replace(max(results, key=lambda result: result.rank), starts=starts)


def phase_on(pupil: Pupil, profile: FisherPhase) -> Tensor:
    """(nodes, nodes) phase of a design on the nodes of a pupil, without its focus.

    Args:
        profile: what was designed or computed.
    """
    return _Phase(pupil, 0 if profile.cells else len(profile.controls), profile.zones)(
        profile.controls
    )


def bspline_weights(position: Array, count: int) -> Array:
    """(n, count) weights of uniform cubic B-splines at positions in [-1, 1].

    Positions beyond the ends take the weights of the end. Every row sums to 1.

    Args:
        position: (n,) positions over the aperture radius.
        count: number of control points, 4 or more.
    """
    scaled = (np.clip(position, -1, 1) + 1) / 2 * (count - 3)
    knots = np.arange(-3.0, count + 1)
    return np.asarray(BSpline.design_matrix(scaled, knots, 3).toarray())


def _climb(
    pupil: Pupil,
    settings: ResolvedFisherSettings,
    objective: AxialObjective,
    focus_um: float,
    zones: int,
    generator: torch.Generator,
) -> FisherPhase:
    """Gradient ascent (Adam) of the objective from one random start, coarse to fine.

    Stage by stage the controls are refined to the next grid. A penalty holds the
    encircled energy above ``settings.encircled`` plus a margin, which follows the
    deterministic figures. Only iterates of the last grid are judged.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
        objective: loss and figures.
        focus_um: source distance of the hyperbolic part, um.
        zones: rings of the double helix; 0 for none.
        generator: of random numbers.
    """
    controls = _initial_controls(settings, zones, generator)
    total = settings.iterations
    done = 0
    margin = 0.01  # encircled energy beyond the bound that the penalty asks for
    best: FisherPhase | None = None
    for grid, count in zip(settings.grids, _shares(settings), strict=True):
        if grid == 0:
            controls = _Phase(pupil, len(controls), 0)(controls)
        elif len(controls) != grid:
            controls = _refined(controls, grid)
        controls = controls.detach().requires_grad_(True)
        rate = RATE if grid else NODE_RATE
        build = _Phase(pupil, grid, zones)
        optimizer = torch.optim.Adam([controls], lr=rate, betas=(0.9, 0.99))
        for _ in range(count):
            for group in optimizer.param_groups:
                group["lr"] = _rate(rate, done, total)
            loss, energy = objective.loss(build(controls), focus_um, generator)
            missing = torch.relu(settings.encircled + margin - energy)
            loss = loss + _penalty(missing, done / total)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            done += 1
            if grid == settings.grids[-1] and (done % CHECKS == 0 or done == total):
                score = objective.judge(build(controls).detach(), focus_um)
                spare = float(score.encircled.min()) - settings.encircled
                latest = FisherPhase(
                    controls.detach().clone(),
                    focus_um,
                    zones,
                    settings.grids[-1] == 0,
                    score,
                    converged=spare >= -5e-4,
                )
                if best is None or latest.rank > best.rank:
                    best = latest
                # proportional feedback, so that the figures exceed the bound by 0.0015
                margin = min(max(margin + 0.35 * (0.0015 - spare), -0.03), 0.05)
        controls = controls.detach()
    if best is None:
        raise ConfigError("no iterate was judged")
    return best


def _initial_controls(
    settings: ResolvedFisherSettings, zones: int, generator: torch.Generator
) -> Tensor:
    """(n, n) random controls of the coarsest grid in rad, normal with ``spread_rad``.

    On a double helix a tenth of the spread, which keeps its vortices.
    """
    spread = settings.spread_rad * (0.1 if zones else 1.0)
    size = settings.grids[0]
    return spread * torch.randn(size, size, generator=generator, dtype=torch.float64)


def _rate(first: float, done: int, total: int) -> float:
    """Step of Adam, rad, after so many of all iterations: half a cosine down to 2
    mrad.
    """
    return first * (0.5 + 0.5 * math.cos(math.pi * done / total)) + 0.002


def _penalty(missing: Tensor, share: float) -> Tensor:
    """Penalty of missing encircled energy m: 10 (1 + 4 share) (mean(m) + 8 mean(m²)).

    Args:
        missing: energy below the bound, 0 or more.
        share: of the iterations that are done; the penalty grows fivefold.
    """
    return 10 * (1 + 4 * share) * (missing.mean() + 8 * (missing**2).mean())


def _shares(settings: FisherSettings) -> list[int]:
    """Iterations of every stage: in proportion to its grid, at least one."""
    weight = sum(settings.grids[:-1]) + (settings.grids[-1] or NODES_WEIGHT)
    early = [
        max(1, settings.iterations * grid // weight) for grid in settings.grids[:-1]
    ]
    return [*early, max(1, settings.iterations - sum(early))]


class _Phase:
    """Linear map from controls to the phase on the pupil's nodes, rad.

    A spline of ``grid`` controls across the aperture, or for a grid of 0 the controls
    themselves, plus the vortices of a double helix.
    """

    def __init__(self, pupil: Pupil, grid: int, zones: int) -> None:
        x, y = (axis.numpy() for axis in pupils.coordinates(pupil))
        vortices = vortex_phase(x, y, radius_um=pupil.radius_um, zones=zones)
        self.base = torch.from_numpy(vortices)
        self.weights = [
            torch.from_numpy(bspline_weights(axis.ravel() / pupil.radius_um, grid))
            for axis in (y, x)
            if grid
        ]

    def __call__(self, controls: Tensor) -> Tensor:
        if not self.weights:
            return self.base + controls
        down, across = self.weights
        spline = ((down @ controls) * across).sum(dim=1)
        return self.base + spline.reshape(self.base.shape)


def _refined(controls: Tensor, grid: int) -> Tensor:
    """The same phase on a finer control grid, in the sense of least squares."""
    place = np.linspace(-1, 1, 4 * grid)
    coarse = bspline_weights(place, len(controls))
    fine = bspline_weights(place, grid)
    change = torch.from_numpy(np.linalg.lstsq(fine, coarse, rcond=None)[0])
    return change @ controls @ change.mT
