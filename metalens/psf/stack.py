"""PSF stack of phase and transmission maps (paper Sec. 3.1, Eqs. 1-3)."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from metalens import propagate
from metalens.core.arrays import Array, to_tensor
from metalens.core.errors import PropagationError
from metalens.lens import NeighbourRows
from metalens.optics import Layers
from metalens.propagate import MovingGeometry, PropagationCase
from metalens.psf import among
from metalens.psf.among import NeighbourJonesFactors
from metalens.psf.budget import Budget, Polarisation
from metalens.psf.compute import ROUNDING, IntensityResult
from metalens.psf.direction import DirectionRequest, compute_direction
from metalens.psf.extended import Extent
from metalens.psf.metrics import blur_um
from metalens.psf.record import PsfStack


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
    source: Extent | None = None,
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
        neighbours: solved rows of unlike pillars, whose coupling multiplies the maps
            (square lattices); None for pillars taken one by one.
        row_um: distance of neighbouring rows where it is not the pitch, else 0.
        site_um2: area of a lattice cell where it is not pitch times row, else 0.

    Sensor distance, depths, angle and offset may be torch tensors that carry gradients;
    the window then moves with the chief ray. Behind a stop each depth is computed
    separately, without derivatives in the geometry.

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
    maps, waves, share = _maps(phase_rad, transmission, wavelength_um, weights)
    maps, wanted = _coupled(
        maps,
        neighbours,
        pitch_um,
        DirectionRequest(tolerance, polarisation, integrate, source),
    )
    about: dict[str, Any] = {
        "pitch_um": pitch_um,
        "row_um": row_um,
        "site_um2": site_um2,
        "window_um": window_um,
    }
    about |= {
        "sensor_distance_um": _value(sensor_distance_um),
        "samples": samples,
        "layers": layers and layers.open,
    }
    about |= {
        "depths_um": np.atleast_1d(np.asarray(_value(depths_um), float)),
        "offset_um": _value(offset_um),
    }
    several, angles = _directions(angle_rad)
    cases, found = [], []
    for angle in angles:
        seen = [
            propagate.make_case(
                maps[0].shape, wavelength_um=w, angle_rad=_value(angle), **about
            )
            for w in waves
        ]
        cases.append(seen[int(share.argmax())])  # all wavelengths share its window
        moving = _geometry_with_gradients(
            angle, depths_um, sensor_distance_um, offset_um, cases[-1]
        )
        found.append(
            _one_direction(
                maps,
                (_with_window_of(seen, cases[-1]), share.tolist(), wanted, moving),
                layers,
            )
        )
    light = torch.stack([row[0] for row in found], dim=-4) if several else found[0][0]
    worst = max(
        (result for row in found for result in row[1]), key=lambda result: result.whole
    )
    stack = _record(
        light, cases, (about["depths_um"], np.array(waves), share), worst, tolerance
    )
    power = torch.stack([row[2] for row in found], dim=-2) if several else found[0][2]
    stack = _with_budget(stack, worst, power * cases[0].area_um2, cases, layers)
    return stack if isinstance(phase_rad, torch.Tensor) else stack.numpy()


_Given = tuple[
    list[PropagationCase], list[float], DirectionRequest, MovingGeometry | None
]  # cases and weights of the wavelengths of a direction
_Found = tuple[torch.Tensor, list[IntensityResult], torch.Tensor]


def _one_direction(
    maps: tuple[torch.Tensor, torch.Tensor], given: _Given, layers: Layers | None
) -> _Found:
    """:func:`direction`, the sum of squares (…, depth), of 1 where it is that of all;
    behind a stop each depth alone,
    whose shadow on the pillars is another at every depth, if it lies before them."""
    cases, weights, wanted, moving = given
    inverse = cases[0].inverse_depths_per_um
    shares = [inverse]
    if layers is not None and layers.stop is not None:
        if moving is not None:
            raise PropagationError(
                "a stop has no derivatives in the geometry: give numbers"
            )
        shares = (
            [inverse] if layers.stop.distance_um == 0 else [(one,) for one in inverse]
        )
    found = []
    for depths in shares:
        seen = [
            dataclasses.replace(case, inverse_depths_per_um=depths) for case in cases
        ]
        found.append(compute_direction(maps, seen, weights, wanted, moving, layers))
    light = (
        found[0][0]
        if len(found) == 1
        else torch.cat([light for light, _, _ in found], -3)
    )
    results = [result for _, some, _ in found for result in some]
    return light, results, torch.stack([power for _, _, power in found], -1)


def _directions(angle_rad: Any) -> tuple[bool, Any]:
    """Whether several field angles are given, and each of them."""
    shape = np.shape(_value(angle_rad))
    if len(shape) == 2 and 0 in shape:
        raise PropagationError(
            f"angle_rad of shape {shape}: need one direction or more"
        )
    return len(shape) == 2, angle_rad if len(shape) == 2 else [angle_rad]


def _with_window_of(
    cases: list[PropagationCase], like: PropagationCase
) -> list[PropagationCase]:
    """The cases with the window of one of them."""
    return [dataclasses.replace(one, centre_um=like.centre_um) for one in cases]


def _coupled(
    maps: tuple[torch.Tensor, torch.Tensor],
    neighbours: NeighbourRows | NeighbourJonesFactors | None,
    pitch_um: float,
    wanted: DirectionRequest,
) -> tuple[tuple[torch.Tensor, torch.Tensor], DirectionRequest]:
    """The maps with the mean factor of unlike neighbours, or as they are and with it on
    both fields.
    """
    if neighbours is None:
        return maps, wanted
    if isinstance(neighbours, NeighbourJonesFactors):
        if wanted.polarisation == "scalar":
            raise PropagationError(
                "factors on both fields, but one scalar: give the rows, or polarisation = 'flux'"
            )
        return maps, dataclasses.replace(wanted, fields=neighbours)
    if wanted.polarisation == "scalar":
        return among.apply_scalar_coupling(*maps, neighbours, pitch_um), wanted
    return maps, dataclasses.replace(
        wanted, fields=among.apply_jones_coupling(*maps, neighbours, pitch_um)
    )


def _stop_error(
    stack: PsfStack, share: Array, cases: list[PropagationCase], layers: Layers | None
) -> float:
    """Error of the shadow of a stop, the worst over angles, depths and wavelengths; nan
    without one.

    share: (…, [angle,] depth) of the light that the windows hold.
    """
    if layers is None or layers.stop is None:
        return math.nan
    light = (
        stack.intensity.detach()
        .cpu()
        .numpy()
        .reshape(-1, len(cases), *stack.intensity.shape[-3:])
    )
    held = share.clip(1e-6, 1).reshape(light.shape[:-2])
    blurs_um, found = blur_um(light, stack.step_um, held), []
    for case, row, shares in zip(cases, blurs_um.max(0), held.min(0), strict=True):
        rads = row / propagate.chief_path(case)
        found += [
            layers.shadow_error(case.tangents, z, w, rad, part)
            for z, rad, part in zip(
                stack.depths_um.tolist(), rads.tolist(), shares.tolist(), strict=True
            )
            for w in stack.wavelengths_um.tolist()
        ]
    return max(found)


def _with_budget(
    stack: PsfStack,
    worst: IntensityResult,
    whole: torch.Tensor,
    cases: list[PropagationCase],
    layers: Layers | None,
) -> PsfStack:
    """With its error by cause; whole: light that leaves the pillars towards the sensor
    for unit irradiance, um².
    """
    share = (stack.energy_um2.detach().cpu().double() / whole).numpy()
    outside, stop = (
        max(0.0, 1 - float(share.min())),
        _stop_error(stack, share, cases, layers),
    )
    parts = {
        "sampling": worst.sampling,
        "source": worst.source,
        "polarisation": worst.rays,
        "stop": stop,
    }
    return dataclasses.replace(
        stack, budget=Budget(worst.error, outside=outside, **parts)
    )


def _record(
    light: torch.Tensor,
    cases: list[PropagationCase],
    axes: tuple[Array, Array, Array],
    worst: IntensityResult,
    tolerance: float,
) -> PsfStack:
    """The stack for intensities (…, depth, y, x), a case for each angle; axes are
    depths, wavelengths, weights.
    """
    energy = light.sum((-1, -2))
    error = worst.whole
    divided = (
        torch.div if light.requires_grad else torch.Tensor.div_
    )  # in place where nothing else looks at it
    return PsfStack(
        divided(light, energy[..., None, None]),
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
        reason=worst.reason
        if error <= tolerance
        else f"{worst.reason}; {_above(worst, tolerance, light.dtype)}",
    )


def _above(worst: IntensityResult, tolerance: float, dtype: torch.dtype) -> str:
    """What keeps an estimate above the tolerance."""
    least = torch.finfo(dtype).eps
    if tolerance < least:
        more = ", give float64 maps" if dtype != torch.float64 else ""
        return f"above the tolerance: {str(dtype).removeprefix('torch.')} holds {least:.2g}{more}"
    terms = {
        "sums": worst.error,
        "integration over cells": worst.sampling,
        "size of the source": worst.source,
    }
    return f"above the tolerance by its {max(terms, key=lambda name: terms[name])}"


def _value(argument: Any) -> Any:
    """An argument without its graph; sequences of tensors become arrays."""
    if isinstance(argument, torch.Tensor):
        return argument.detach().cpu().numpy()
    if isinstance(argument, list | tuple):
        return np.array([_value(a) for a in argument])
    return argument


def _geometry_with_gradients(
    angle: Any, depths: Any, distance: Any, offset: Any, case: PropagationCase
) -> MovingGeometry | None:
    """Geometry as tensors where any of it carries a gradient."""
    given = [
        angle,
        depths,
        distance,
        *(offset if isinstance(offset, list | tuple) else [offset]),
    ]
    if not any(isinstance(g, torch.Tensor) and g.requires_grad for g in given):
        return None
    pair = _double(angle).reshape(-1)
    tangents = torch.tan(
        pair if pair.numel() == 2 else torch.cat([pair, torch.zeros_like(pair)])
    )
    d = _double(distance).reshape(())
    shift = torch.stack([_double(o).reshape(()) for o in offset])
    meets = torch.stack(
        [propagate.chief_ray_offset(case.behind, d, tangents, i) for i in (0, 1)]
    )
    return MovingGeometry(tangents, 1 / _double(depths).reshape(-1), d, meets + shift)


def _double(argument: Any) -> torch.Tensor:
    if isinstance(argument, torch.Tensor):
        return argument.double()
    return torch.as_tensor(np.asarray(argument, float))


def _maps(
    phase: Any,
    level: Any,
    wavelength_um: float | Sequence[float],
    weights: Sequence[float] | None,
) -> tuple[tuple[torch.Tensor, torch.Tensor], list[float], Array]:
    """Maps (…, wavelength, y, x) as tensors of one dtype, the wavelengths, and their
    weights of sum 1.
    """
    waves = np.atleast_1d(np.asarray(wavelength_um, float)).ravel().tolist()
    if not waves:
        raise PropagationError("wavelength_um is empty, need one wavelength or more")
    share = (
        np.full(len(waves), 1 / len(waves))
        if weights is None
        else np.asarray(weights, float)
    )
    if share.shape != (len(waves),) or not (share >= 0).all() or not share.sum() > 0:
        raise PropagationError(
            f"{len(waves)} wavelengths with weights {share.tolist()}, need one weight >= 0 for each"
        )
    phase = to_tensor(phase).cpu()  # pillars are summed on the processor
    if phase.dtype not in ROUNDING:
        raise PropagationError(f"phase_rad is {phase.dtype}, need float32 or float64")
    level = to_tensor(level).to(phase)
    if phase.ndim < 2 or 0 in phase.shape[:-2] or not _broadcasts(level, phase):
        shapes = f"phase_rad of shape {tuple(phase.shape)}, transmission of {tuple(level.shape)}"
        raise PropagationError(f"{shapes}: need (…, y, x) of both, alike")
    level = level.expand(phase.shape)
    if np.ndim(wavelength_um) == 0:
        phase, level = phase.unsqueeze(-3), level.unsqueeze(-3)
    elif phase.ndim < 3 or phase.shape[-3] != len(waves):
        raise PropagationError(
            f"{len(waves)} wavelengths, but maps of shape {tuple(phase.shape)}; need (…, wavelength, y, x)"
        )
    return (phase, level), waves, share / share.sum()


def _broadcasts(level: torch.Tensor, phase: torch.Tensor) -> bool:
    """Whether a transmission is one of these maps, or of all of them."""
    alike = zip(level.shape[::-1], phase.shape[::-1], strict=False)
    return level.ndim <= phase.ndim and all(n in (1, m) for n, m in alike)
