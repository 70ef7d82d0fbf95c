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
from metalens.design import Focus, PhaseOf, hyperbolic_phase
from metalens.design.free_form.settings import FisherSettings, ResolvedFisherSettings
from metalens.image import (
    Field,
    Pupil,
    axial_information,
    encircled_energy,
    pixel_information,
)
from metalens.image import pupil as pupils

SMOOTH = 11  # iterations per iteration on the spline
CHECKS = 20  # iterations between two evaluations of the deterministic figures
CLIMB_IMAGES = 4  # images of a gradient step, at least two for every field angle


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


def axial_loss(
    phase_rad: Tensor,
    pupil: Pupil,
    focus_um: float,
    settings: ResolvedFisherSettings,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Minus the log of the axial information I(z) at random depths, and the encircled
    energy there.

    With e = ``settings.even``: -mean over positions of e mean(log I) + (1 - e)
    log(mean I), I per mm² of the images, the means over depths. Depths are stratified
    over the range, azimuths of the field are multiples of 90 degrees, and two positions
    of the pixel grid are drawn. Every field angle has the same weight.

    Args:
        phase_rad: (nodes, nodes) phase without its focus, rad.
        pupil: sampled pupil of the lens.
        focus_um: source distance of the hyperbolic part, um.
        settings: resolved settings of the design.
        generator: of random depths, fields and positions.
    """
    angles = settings.angles_deg
    low, high = (1e3 * d for d in settings.depths_mm)
    count = max(2, math.ceil(CLIMB_IMAGES / len(angles))) * len(angles)
    strata = torch.randperm(count, generator=generator) + torch.rand(
        count, generator=generator
    )
    depths = low + (high - low) / count * strata.double()
    turns = torch.randint(0, 4, (count,), generator=generator).tolist()
    fields = [_field(angles[i % len(angles)], t / 4) for i, t in enumerate(turns)]
    positions = torch.rand(2, 2, generator=generator) - 0.5  # in pixels
    width = settings.climb_window_um
    near, far = _stacks(phase_rad, pupil, focus_um, depths, fields, settings, width)
    total = phase_rad.new_zeros(())
    for y, x in (positions * settings.pixel_um).tolist():
        value = pixel_information(
            near, far, shift_um=(y, x), **_information_options(settings)
        )
        value = value.reshape(-1, len(angles))
        mean_log = torch.log(value + 1e-4).mean()
        log_mean = torch.log(value.mean(0) + 1e-4).mean()
        gain = settings.even * mean_log + (1 - settings.even) * log_mean
        total = total - gain / len(positions)
    radius_um = settings.radius_um
    return total, encircled_energy(near, settings.sample_um, radius_um=radius_um)


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
    return DesignScore(torch.stack(values).squeeze(0), torch.stack(energies).squeeze(0))


def _information_options(settings: ResolvedFisherSettings) -> dict[str, Any]:
    """Arguments of the information of Eq. 11: lengths in um, and the normalisation."""
    return {
        "step_um": settings.step_um,
        "sample_um": settings.sample_um,
        "pixel_um": settings.pixel_um,
        "normalisation": settings.normalisation,
    }


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
    stack = pupils.psf(
        phase_rad,
        pupil,
        depths_um=both,
        fields=fields * 2,
        focus_um=focus_um,
        sample_um=sample,
        samples=samples,
    )
    return stack[: len(depths_um)], stack[len(depths_um) :]


@dataclass(frozen=True, eq=False, slots=True)
class FisherPhase:
    """A designed free-form phase.

    nodes_rad: (n, n) free phase of every node of the pupil.
    focus_um: source distance of the hyperbolic part.
    score: of this phase.
    converged: whether the encircled energy is kept at every depth.
    starts: (information, least encircled energy) of each start.
    """

    nodes_rad: Tensor
    focus_um: float
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

    phase(x, y) = hyperbolic phase + free phase of the nearest node.

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
    free_rad = design.nodes_rad.numpy()

    def phase(x_um: Array, y_um: Array) -> Array:
        y = y_um[:, None]
        cosines = np.sqrt(x_um**2 + y**2 + pupil.sensor_distance_um**2)
        place = (pupil.nodes - 1) / 2
        row, column = (
            np.rint(a / cosines * pupil.nodes / (2 * pupil.edge) + place)
            .clip(0, pupil.nodes - 1)
            .astype(np.intp)
            for a in (y, x_um)
        )
        return np.asarray(hyperbolic_phase(x_um, y, base) + free_rad[row, column])

    return phase, design


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
    results = []
    for start in range(settings.starts):
        share = (start + 0.5) / settings.starts
        focus = 1e3 * (
            settings.focus_mm[0] + share * (settings.focus_mm[1] - settings.focus_mm[0])
        )
        generator = torch.Generator().manual_seed(1000 * settings.seed + start)
        results.append(_climb(pupil, settings, focus, generator))
    starts = tuple((r.rank[1], float(r.score.encircled.min())) for r in results)
    return replace(max(results, key=lambda result: result.rank), starts=starts)


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
    focus_um: float,
    generator: torch.Generator,
) -> FisherPhase:
    """Gradient ascent (Adam) of the objective from one random start, coarse to fine.

    A spline of ``settings.controls`` across the aperture is followed by a free phase of
    every node. A penalty holds the encircled energy above ``settings.encircled`` plus a
    margin, which follows the deterministic figures. Only the free phases are judged.

    Args:
        pupil: sampled pupil of the lens.
        settings: resolved settings of the design.
        focus_um: source distance of the hyperbolic part, um.
        generator: of random numbers.
    """
    size = settings.controls
    values = settings.spread_rad * torch.randn(
        size, size, generator=generator, dtype=torch.float64
    )
    down, across = (
        torch.from_numpy(bspline_weights(axis.ravel() / pupil.radius_um, size))
        for axis in reversed([a.numpy() for a in pupils.coordinates(pupil)])
    )
    total = settings.iterations
    first = min(max(1, total // SMOOTH), total - 1)
    margin = 0.01  # encircled energy beyond the bound that the penalty asks for
    judged: list[FisherPhase] = []
    # smooth, first step of Adam in rad (large ones leave poor optima), iterations
    stages = (True, 0.15, range(first)), (False, 0.5, range(first, total))
    for smooth, rate, steps in stages:
        if not smooth:
            values = ((down @ values) * across).sum(1).reshape(pupil.nodes, -1)
        values = values.detach().requires_grad_(True)
        optimizer = torch.optim.Adam([values], lr=rate, betas=(0.9, 0.99))
        for done in steps:
            for group in optimizer.param_groups:
                group["lr"] = _rate(rate, done, total)
            free = values
            if smooth:
                free = ((down @ values) * across).sum(1).reshape(pupil.nodes, -1)
            loss, energy = axial_loss(free, pupil, focus_um, settings, generator)
            missing = torch.relu(settings.encircled + margin - energy)
            loss = loss + _penalty(missing, done / total)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            if smooth or ((done + 1) % CHECKS and done + 1 < total):
                continue
            nodes = values.detach().clone()
            score = score_phase(nodes, pupil, focus_um=focus_um, settings=settings)
            spare = float(score.encircled.min()) - settings.encircled
            judged.append(FisherPhase(nodes, focus_um, score, spare >= -5e-4))
            # proportional feedback, so that the figures exceed the bound by 0.0015
            margin = min(max(margin + 0.35 * (0.0015 - spare), -0.03), 0.05)
    return max(judged, key=lambda design: design.rank)


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
