"""PSF stack of phase and transmission maps (paper Sec. 3.1, Eqs. 1-3)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from metalens import propagate
from metalens.core.arrays import Array, to_tensor
from metalens.core.errors import PropagationError
from metalens.lens import NeighbourRows
from metalens.optics import Layers
from metalens.propagate import PropagationCase
from metalens.psf import neighbour_coupling
from metalens.psf.budget import Polarisation
from metalens.psf.extended import SourceExtent
from metalens.psf.intensity import (
    ROUNDING,
    IntensityRequest,
    IntensityResult,
    Maps,
    compute_intensity,
)
from metalens.psf.metrics import blur_um
from metalens.psf.neighbour_coupling import NeighbourJonesFactors
from metalens.psf.record import PsfStack
from metalens.psf.spectrum import SpectralNodes
from metalens.psf.vector import PolarizationMixing, jones_maps


def psf_stack(
    phase_rad: Any,
    transmission: Any,
    *,
    pitch_um: float,
    wavelength_um: float | Sequence[float],
    sensor_distance_um: Any,
    depths_um: Any,
    angle_rad: Any = 0.0,
    window_um: float | tuple[float, float],
    samples: int | tuple[int, int],
    tolerance: float = 1e-4,
    weights: Sequence[float] | None = None,
    offset_um: Any = (0.0, 0.0),
    layers: Layers | None = None,
    polarisation: Polarisation = "scalar",
    integrate: bool = True,
    source: SourceExtent | None = None,
    neighbours: NeighbourRows | NeighbourJonesFactors | None = None,
    row_um: float = 0.0,
    site_um2: float = 0.0,
) -> PsfStack:
    """Point spread functions of a metalens by Rayleigh-Sommerfeld diffraction.

    Every pillar of area p² sends a spherical wave to the sensor; the PSF is the
    irradiance |U|² on a window about the chief ray, for each depth of a point source:

        U(X) = Σ p² T exp(iφ) U_in d / (2π r²) (1/r - ik) exp(ikr)

    (Goodman, Introduction to Fourier Optics, eq. 3-43; paper Eqs. 1-3). Light travels
    along +z with the time factor exp(-iωt), so the phase of a focusing lens falls
    towards its rim. +x is right, +y is down.

    Args:
        phase_rad: (…, y, x) phase of every pillar, numpy or torch, float32 or float64.
            Leading axes are a batch of lenses; with several wavelengths the axis before
            y is the wavelength. Torch maps are differentiable once.
        transmission: (…, y, x) magnitude |T| of every pillar, 0 where there is none.
        pitch_um: distance of neighbouring columns.
        wavelength_um: in vacuum where ``layers`` are given, else in the medium; a
            number, or several whose irradiances add with ``weights``.
        sensor_distance_um: from the pillars to the sensor.
        depths_um: (depth,) distances of the source from the lens along its axis, inf
            for a plane wave.
        angle_rad: field angle along x, a pair (x, y), or (n, 2) for several. Light goes
            along slopes dx/dz = tan x, dy/dz = tan y: a positive angle moves the image
            to +x (+y), and the source lies at -x (-y).
        window_um: full width of the window, or a pair (x, y).
        samples: cells along the window, or a pair (x, y); samples lie at cell centres.
        tolerance: relative L2 error of the PSFs of one direction.
        weights: of the wavelengths; None for equal.
        offset_um: (x, y) from the chief ray to the window's middle.
        layers: films and aperture stop around the lens, and the medium behind it.
        polarisation: ``"scalar"``; ``"flux"`` through the sensor's plane of both
            polarisations, which a pixel counts; or ``"vector"``, |Ex|² + |Ey|² + |Ez|².
        integrate: means over cells where samples would alias; False for samples at the
            cell centres in any case.
        source: size and shape of a source that is no point.
        neighbours: solved rows of non-identical pillars, whose coupling multiplies the maps
            (square lattices); None for pillars taken one by one.
        row_um: distance of neighbouring rows where it is not the pitch, else 0.
        site_um2: area of a lattice cell where it is not pitch times row, else 0.

    Behind a stop each depth is computed separately.

    Returns:
        PsfStack: ``intensity`` (…, [angle,] depth, y, x), each PSF of sum 1, of the
            kind
        and dtype that came in; ``energy_um2``, ``error``, ``budget``.

    Raises:
        PropagationError: empty aperture, NaN (row and column named), impossible
            geometry, no light in the window, a tolerance not above 0, a window that no
            method reaches, a source of finite size in um at infinity.

    Accuracy: ``error`` is 1 to 3 times the true error, measured at points of the
    window.
    Reference: :func:`metalens.propagate.exact`, the same sum pillar by pillar.

    >>> import numpy as np
    >>> x = (np.arange(64) - 31.5) * 0.4
    >>> path = np.sqrt(x**2 + x[:, None] ** 2 + 100.0**2)  # hyperbolic lens, f = 100 um
    >>> stack = psf_stack(
    ...     -2 * np.pi / 0.85 * path, np.ones((64, 64)), pitch_um=0.4,
    ...     wavelength_um=0.85, sensor_distance_um=100.0, depths_um=[np.inf],
    ...     window_um=20.0, samples=21,
    ... )
    >>> stack.intensity.shape, stack.converged
    ((1, 21, 21), True)
    """
    if not 0 < tolerance < 1:
        raise PropagationError(
            f"tolerance is {tolerance}, need a relative error above 0 and below 1"
        )
    places = sensor_distance_um, depths_um, angle_rad, offset_um
    if any(getattr(place, "requires_grad", False) for place in places):
        raise PropagationError(
            "the geometry carries a gradient, but PSFs are differentiable in the maps alone: detach it, and take "
            "differences of two stacks"
        )
    maps, waves, weight = _maps(phase_rad, transmission, wavelength_um, weights)
    shape = maps[0].shape
    maps, mixing = _polarised(maps, polarisation, neighbours, pitch_um)
    depths = np.atleast_1d(np.asarray(depths_um, float))
    geometry: dict[str, Any] = {
        "pitch_um": pitch_um,
        "row_um": row_um,
        "site_um2": site_um2,
        "window_um": window_um,
        "sensor_distance_um": sensor_distance_um,
        "samples": samples,
        "layers": layers and layers.open,
        "depths_um": depths,
        "offset_um": offset_um,
    }
    has_angle_axis = np.ndim(angle_rad) == 2
    angles = angle_rad if has_angle_axis else [angle_rad]
    if not len(angles):
        raise PropagationError("angle_rad is empty: need one direction or more")
    lenses = [m.reshape(-1, *m.shape[-3:]) for m in maps]
    cases: list[PropagationCase] = []
    results: list[list[IntensityResult]] = []
    for angle in angles:
        by_wave = [
            propagate.make_case(shape, wavelength_um=wave, angle_rad=angle, **geometry)
            for wave in waves
        ]
        cases.append(by_wave[int(weight.argmax())])  # all wavelengths share its window
        by_wave = [replace(case, centre_um=cases[-1].centre_um) for case in by_wave]
        results.append(
            [
                compute_intensity(
                    IntensityRequest(
                        (phase, level),
                        by_wave,
                        weight.tolist(),
                        tolerance,
                        mixing,
                        layers,
                        integrate,
                        source,
                    )
                )
                for phase, level in zip(*lenses, strict=True)
            ]
        )
    batch = (*shape[:-3], *[len(cases)] * has_angle_axis)
    axes = depths, np.array(waves), weight
    stack = _record(results, batch, cases, axes, tolerance, layers)
    return stack if isinstance(phase_rad, torch.Tensor) else stack.numpy()


def _polarised(
    maps: Maps,
    polarisation: Polarisation,
    neighbours: NeighbourRows | NeighbourJonesFactors | None,
    pitch_um: float,
) -> tuple[Maps, PolarizationMixing | None]:
    """Maps with the coupling of neighbours, and the mixing of both polarisations.

    The scalar multiplies the maps by the mean coupling and has no mixing (None). Where
    coupling turns the polarisation, three maps stand for every wavelength.

    Args:
        maps: phase in rad and transmission, each (…, wavelength, y, x).
        polarisation: ``"scalar"``, ``"flux"`` or ``"vector"``.
        neighbours: solved rows of unequal neighbours, or their factors on both fields.
        pitch_um: distance of neighbouring pillars, um.
    """
    if polarisation == "scalar":
        if isinstance(neighbours, NeighbourJonesFactors):
            raise PropagationError(
                "factors on both fields, but one scalar: give the rows, or polarisation = 'flux'"
            )
        if neighbours is not None:
            maps = neighbour_coupling.apply_scalar_coupling(*maps, neighbours, pitch_um)
        return maps, None
    if polarisation not in ("flux", "vector"):
        raise PropagationError(
            f"polarisation = {polarisation!r}: need one of scalar, flux, vector"
        )
    if isinstance(neighbours, NeighbourRows):
        neighbours = neighbour_coupling.apply_jones_coupling(
            *maps, neighbours, pitch_um
        )
    if neighbours is not None:
        maps = jones_maps(maps, neighbours)
    return maps, PolarizationMixing(polarisation == "flux", neighbours is not None)


def _record(
    by_direction: list[list[IntensityResult]],
    batch: tuple[int, ...],
    cases: list[PropagationCase],
    axes: tuple[Array, Array, Array],
    tolerance: float,
    layers: Layers | None,
) -> PsfStack:
    """PSF stack of the results of all directions and lenses, each PSF of sum 1.

    The error and its budget are those of the worst result.

    Args:
        by_direction: results of each direction, each a list over lenses.
        batch: (…, [angle]) leading shape of the stack.
        cases: geometry of each direction.
        axes: depths in um, wavelengths in um and their weights.
        tolerance: relative L2 error that was asked for.
        layers: films and stop; None for a bare lens.
    """
    results = [result for row in zip(*by_direction, strict=True) for result in row]
    light = torch.stack([result.intensity for result in results])
    light = light.view(*batch, *light.shape[1:])
    energy = light.sum((-1, -2))
    power = np.reshape([result.power for result in results], energy.shape)
    share = energy.detach().double().numpy() * cases[0].step_um ** 2
    share = share / (power * cases[0].area_um2)
    worst = max(results, key=lambda result: result.budget.computed)
    error = worst.budget.computed
    reason = worst.reason
    if error > tolerance:
        reason += f"; above the tolerance by its {worst.budget.largest}"
    if tolerance < (least := torch.finfo(light.dtype).eps):
        name = str(light.dtype).removeprefix("torch.")
        reason += f"; {name} holds {least:.2g}, give float64 maps"
    divide = torch.div if light.requires_grad else torch.Tensor.div_  # in place
    light = divide(light, energy[..., None, None])
    budget = replace(worst.budget, outside=max(0.0, 1 - float(share.min())))
    if layers is not None and layers.stop is not None:
        budget = replace(budget, stop=_stop_error(light, share, cases, axes, layers))
    return PsfStack(
        light,
        energy * cases[0].step_um ** 2,
        depths_um=axes[0],
        angles_rad=np.arctan([c.tangents for c in cases]),
        wavelengths_um=axes[1],
        weights=axes[2],
        step_um=cases[0].step_um,
        centres_um=np.array([c.centre_um for c in cases]),
        sensor_distance_um=cases[0].sensor_distance_um,
        tolerance=tolerance,
        error=error,
        reason=reason,
        budget=budget,
    )


def _stop_error(
    psfs: torch.Tensor,
    share: Array,
    cases: list[PropagationCase],
    axes: tuple[Array, Array, Array],
    layers: Layers,
) -> float:
    """Relative error of the stop's shadow, the worst over angles, depths, wavelengths.

    Args:
        psfs: (…, angle, depth, y, x) PSFs of sum 1.
        share: (…, angle, depth) share of the light that falls in the window.
        cases: geometry of each direction.
        axes: depths in um, wavelengths in um and their weights.
        layers: with the stop.
    """
    light = psfs.detach().numpy().reshape(-1, len(cases), *psfs.shape[-3:])
    share = share.clip(1e-6, 1).reshape(light.shape[:-2])
    blurs_um = blur_um(light, cases[0].step_um, share)
    return max(
        layers.shadow_error(
            case.tangents, z, wave, blur / propagate.chief_path(case), part
        )
        for case, blurs, parts in zip(cases, blurs_um.max(0), share.min(0), strict=True)
        for z, blur, part in zip(axes[0].tolist(), blurs, parts, strict=True)
        for wave in axes[1].tolist()
    )


def _maps(
    phase: Any,
    level: Any,
    wavelength_um: float | Sequence[float],
    weights: Sequence[float] | None,
) -> tuple[tuple[torch.Tensor, torch.Tensor], list[float], Array]:
    """Maps as tensors of one dtype, wavelengths in um, and their weights of sum 1.

    Args:
        phase: (…, y, x) rad; several wavelengths are the axis before y.
        level: (…, y, x) transmission, of the shape of the phase or one that broadcasts.
        wavelength_um: one wavelength or several.
        weights: of the wavelengths; None for equal.

    Returns:
        ((phase, transmission), wavelengths, weights); maps (…, wavelength, y, x).
    """
    waves = np.ravel(np.asarray(wavelength_um, float))
    share = np.asarray(np.ones(len(waves)) if weights is None else weights, float)
    nodes = SpectralNodes(waves, share / max(share.sum(), 1e-300), 0.0)
    phase = to_tensor(phase).cpu()  # pillars are summed on the processor
    if phase.dtype not in ROUNDING:
        raise PropagationError(f"phase_rad is {phase.dtype}, need float32 or float64")
    try:
        level = to_tensor(level).to(phase).expand(phase.shape)
    except RuntimeError:
        shapes = f"phase_rad of shape {tuple(phase.shape)}, transmission of {np.shape(level)}"
        raise PropagationError(f"{shapes}: need the same (…, y, x) of both") from None
    if phase.ndim < 2 or 0 in phase.shape[:-2]:
        raise PropagationError(
            f"phase_rad of shape {tuple(phase.shape)}: need (…, y, x)"
        )
    if np.ndim(wavelength_um) == 0:
        phase, level = phase.unsqueeze(-3), level.unsqueeze(-3)
    elif phase.ndim < 3 or phase.shape[-3] != len(waves):
        raise PropagationError(
            f"{len(waves)} wavelengths, but maps of shape {tuple(phase.shape)}; need (…, wavelength, y, x)"
        )
    return (phase, level), waves.tolist(), nodes.weights
