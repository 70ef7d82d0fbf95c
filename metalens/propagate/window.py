"""Windowed propagation: only the field on the sensor window, from Legendre moments of
the lens.
"""

import dataclasses
import functools
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import one_blas_thread
from metalens.propagate.geometry import PropagationCase, window_tiles
from metalens.propagate.nodes import WindowLayout, plan_layout
from metalens.propagate.operators import (
    DepthBasis,
    build_operators,
    depth_basis,
    depth_factors,
    significant_pairs,
)
from metalens.propagate.paths import over_blocks, reference_depth, to_sensor
from metalens.propagate.pillars import (
    PillarMoments,
    Pupils,
    mix_components,
    plan_moments,
    reduce_to_moments,
)
from metalens.propagate.wide import WidePlan, wide_plan

SMOOTH = (
    4,
    2,
)  # nodes more over the lens, and in a block, where light is multiplied by such factors there
MORE = 8  # orders of the moments beyond those used, for the posterior error
KEPT_BYTES = 400e6  # of plans that are kept
BUDGET_BYTES = 8e6  # of what is multiplied at once: larger blocks leave the cache


@dataclass(frozen=True, eq=False, slots=True)
class WindowPlan:
    """Everything that depends on the geometry alone, ready for many lenses.

    The moments go ``MORE`` orders beyond what the method uses, for the error estimate.
    tensors: the operators, those of the tiles stacked (tile, …); ``turn`` (tile, e, x)
    is the phase from the window's centre to the tile's own on the nodes of the whole
    window.
    """

    case: PropagationCase
    tolerance: float
    layout: WindowLayout
    depths: DepthBasis
    moments: PillarMoments
    tensors: dict[str, torch.Tensor]
    slopes: dict[int, dict[str, torch.Tensor]] = dataclasses.field(default_factory=dict)

    @property
    def nodes_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the lens nodes of the tiles."""
        return _nodes_um(self.case, self.layout.sizes.nodes)

    @property
    def whole_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the lens nodes of the whole window."""
        return _nodes_um(self.case, self.layout.nodes)

    @property
    def judged_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the nodes that its moments stand for, ``MORE`` than
        those.
        """
        ny, nx = self.layout.nodes
        return _nodes_um(self.case, (ny + MORE, nx + MORE))

    @property
    def bytes(self) -> int:
        """Memory that its arrays take."""
        held = [
            *self.tensors.values(),
            *(t for made in self.slopes.values() for t in made.values()),
        ]
        held += [self.moments.rows, self.moments.columns]
        arrays = [self.depths.basis, self.depths.coefficients, self.moments.table]
        return sum(int(t.nbytes) for t in held) + sum(
            int(a.nbytes) for a in arrays if a is not None
        )


@dataclass(frozen=True, eq=False, slots=True)
class MovingGeometry:
    """Geometry that carries gradients, float64 tensors: tangents (2,), inverse depths
    (depth,), sensor distance (),
    window centre (2,). Values must be those of the plan's case."""

    tangents: torch.Tensor
    inverse_depths: torch.Tensor
    distance: torch.Tensor
    centre: torch.Tensor


Kept = TypeVar("Kept", WindowPlan, WidePlan)
_kept: dict[tuple[Any, ...], Any] = {}  # used last at the end
_lock = threading.Lock()


def plan_window(
    case: PropagationCase,
    tolerance: float,
    dtype: torch.dtype,
    moving: bool = False,
    *,
    smooth: bool = False,
) -> WindowPlan:
    """Plan a windowed propagation; those used last are kept, as many as fit in
    ``KEPT_BYTES``.

    Args:
        case, tolerance: geometry, and relative error of the field.
        dtype: of the maps; sums over blocks of pillars are in float64.
        moving: for use with :class:`MovingGeometry`.
        smooth: with factors (``Pupils``) on the light of the nodes.

    Raises:
        PropagationError: the window is too large for the method.
    """
    made = functools.partial(
        _planned, case, tolerance, dtype, moving=moving, smooth=smooth
    )
    return _keep((case, tolerance, dtype, moving, smooth), made)


def plan_wide(case: PropagationCase, tolerance: float, dtype: torch.dtype) -> WidePlan:
    """Plan a wide window (:mod:`metalens.propagate.wide`); kept with the others.

    Args:
        case, tolerance: geometry, and relative error of the field.
        dtype: of the maps and of the transforms.

    Raises:
        PropagationError: rays too steep for the method.
    """
    made = functools.partial(wide_plan, case, tolerance, dtype)
    return _keep((case, tolerance, dtype, "wide"), made)


def _keep(key: tuple[Any, ...], made: Callable[[], Kept]) -> Kept:
    """The plan that is kept under a key, or a new one."""
    with _lock:
        found = _kept.pop(key, None)
        if found is not None:
            _kept[key] = found
            return found  # type: ignore[no-any-return]
    with one_blas_thread():
        found = made()
    with _lock:
        _kept[key] = found
        room = KEPT_BYTES
        for other in reversed(list(_kept)):
            room -= _kept[other].bytes
            if room < 0 and other != key:
                del _kept[other]
    return found


def _planned(
    case: PropagationCase,
    tolerance: float,
    dtype: torch.dtype,
    *,
    moving: bool,
    smooth: bool,
) -> WindowPlan:
    """A new plan."""
    found = plan_layout(case, tolerance)
    if found is None:
        raise PropagationError(
            "the window is too large for one plan; see propagate.choose, or make it smaller"
        )
    lens, inside = SMOOTH if smooth else (0, 0)
    ny, nx = (n + lens for n in found.nodes)
    found = dataclasses.replace(found, nodes=(ny, nx))
    reference = reference_depth(case)
    pillars = plan_moments(
        case,
        reference,
        legendre_bases(case, (ny + MORE, nx + MORE)),
        over_blocks(case),
        tolerance=tolerance,
        dtype=dtype,
        more=inside,
    )
    depths = depth_basis(
        case, _nodes_um(case, found.sizes.nodes), tolerance / 2, moving=moving
    )
    tensors = _shared(case, found, depths) | _stacked(case, found, depths, tolerance)
    return WindowPlan(case, tolerance, found, depths, pillars, tensors)


def legendre_bases(
    case: PropagationCase, counts: tuple[int, int]
) -> tuple[Callable[[Array], Array], ...]:
    """Legendre polynomials over the rows and over the columns of the lens, as weights
    of :func:`moments`.

    Args:
        case: geometry of the propagation.
        counts: (y, x) numbers of polynomials.
    """

    def over(count: int, half_um: float) -> Callable[[Array], Array]:
        return lambda places_um: legendre.legendre_values(count, places_um / half_um)

    return tuple(over(n, h) for n, h in zip(counts, case.half_size_um, strict=True))


def _nodes_um(case: PropagationCase, counts: tuple[int, int]) -> tuple[Array, Array]:
    hy, hx = case.half_size_um
    return np.asarray(legendre.mapped_nodes(counts[0], -hy, hy)), np.asarray(
        legendre.mapped_nodes(counts[1], -hx, hx)
    )


def _shared(
    case: PropagationCase, found: WindowLayout, depths: DepthBasis
) -> dict[str, torch.Tensor]:
    """Moments to the nodes of the window, those to the nodes of the tiles, and the
    depths.
    """
    arrays = {"basis": depths.basis, "coefficients": depths.coefficients}
    for name, all_, few in zip(
        ("rows", "columns"), found.nodes, found.sizes.nodes, strict=True
    ):
        arrays[f"{name}_to_nodes"] = legendre.to_nodes(all_)
        arrays[f"{name}_to_tile"] = legendre.interpolation_matrix(
            few, legendre.gauss_legendre_nodes(all_)[0]
        )
    e, x = _nodes_um(case, found.nodes)
    parts = [part for row in window_tiles(case, found.parts)[1] for part in row]
    away = [to_sensor(c, x, e[:, None]) for c in (case, *parts)]
    arrays["turn"] = np.exp(1j * case.wavenumber * (np.stack(away[1:]) - away[0]))
    return {name: torch.tensor(a, dtype=torch.complex128) for name, a in arrays.items()}


def _stacked(
    case: PropagationCase,
    found: WindowLayout,
    depths: DepthBasis,
    tolerance: float,
    slope: int | None = None,
) -> dict[str, torch.Tensor]:
    """Operators of all tiles (tile, …) for the pairs of terms and depth fields that any
    of them needs; ``fields`` are
    the depth fields of the pairs."""
    parts = [part for row in window_tiles(case, found.parts)[1] for part in row]
    made = [
        build_operators(part, found.sizes, tolerance, slope=slope) for part in parts
    ]
    most = max(len(one.strength) for one in made)
    strength = np.max([_padded(one.strength, most) for one in made], axis=0)
    kept = significant_pairs(strength, depths.strength, tolerance / 2)
    arrays = {
        name: np.stack([getattr(one, name) for one in made])
        for name in ("along_y", "along_x")
    }
    for name in ("lens_terms", "window_terms"):
        arrays[name] = np.stack(
            [_padded(getattr(one, name), most)[..., kept[0]] for one in made]
        )
    out = {name: torch.tensor(a, dtype=torch.complex128) for name, a in arrays.items()}
    directions = np.concatenate([one.to_directions for one in made])
    out["to_directions"] = torch.tensor(directions)
    out["fields"] = torch.tensor(kept[1])
    return out


def _padded(array: Array, count: int) -> Array:
    """With zeros to ``count`` along the last axis."""
    return np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, count - array.shape[-1])])


def _slope(plan: WindowPlan, axis: int) -> dict[str, torch.Tensor]:
    """Tensors of the derivative in sensor distance, window centre x, y (axis 0, 1, 2);
    kept with the plan.
    """
    if axis not in plan.slopes:
        plan.slopes[axis] = _stacked(
            plan.case, plan.layout, plan.depths, plan.tolerance, axis
        )
    return plan.slopes[axis]


def field_windowed(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: WindowPlan
) -> torch.Tensor:
    """(depth, y, x) complex field on the window, differentiable once in both maps.

    Args:
        phase_rad, transmission: (y, x) maps. plan: of :func:`plan_window`.
    """
    moments, _ = reduce_to_moments(phase_rad, transmission, plan.moments)
    return _from_nodes(_on_nodes(moments, plan), plan, None)


def light_windowed(
    maps: tuple[torch.Tensor, torch.Tensor],
    plan: WindowPlan,
    moving: MovingGeometry | None,
    pupils: Pupils | None,
) -> tuple[torch.Tensor, Array, list[float]]:
    """Irradiance on the window (depth, y, x); light of every map on the nodes of the
    posterior error; sums of squares of the transmissions.

    Differentiable once in the maps, and in ``moving`` where given.

    Args:
        maps: (map, y, x) phase and transmission. plan: of :func:`plan_window`.
        moving: geometry with gradients. pupils: factors on the light of the maps, for a
            plan made ``smooth``; None for the |U|² of one map.
    """
    found = [reduce_to_moments(p, t, plan.moments) for p, t in zip(*maps, strict=True)]
    moments, powers = torch.stack([m for m, _ in found]), [power for _, power in found]
    parts = mix_components(_on_nodes(moments, plan), pupils, plan.whole_um)
    total: Any = 0
    for sign, light in parts:
        field = _from_nodes(light, plan, moving)
        total = total + sign * (field.real**2 + field.imag**2)
    fine, (m, n) = moments.detach().numpy(), moments.shape[-2:]
    with one_blas_thread():
        return total, legendre.to_nodes(m).T @ fine @ legendre.to_nodes(n), powers


def _on_nodes(gathered: torch.Tensor, plan: WindowPlan) -> torch.Tensor:
    """(…, e, x) light on the nodes of the whole window from moments (…, m, n)."""
    ny, nx = plan.layout.nodes
    return (
        plan.tensors["rows_to_nodes"].T
        @ gathered[..., :ny, :nx]
        @ plan.tensors["columns_to_nodes"]
    )


def _from_nodes(
    light: torch.Tensor, plan: WindowPlan, moving: MovingGeometry | None
) -> torch.Tensor:
    """(depth, y, x) field on the window from the light on its nodes."""
    t = plan.tensors
    fewer = t["rows_to_tile"].T @ (light * t["turn"]) @ t["columns_to_tile"]
    coefficients = t["coefficients"] if moving is None else _coefficients(plan, moving)
    given = fewer[:, None] * t["basis"]
    field = _at_depths(zoom_to_tiles(given, t), coefficients)
    if moving is not None:
        for axis, value in enumerate(
            (moving.distance, moving.centre[0], moving.centre[1])
        ):
            if value.requires_grad:
                rate = _at_depths(
                    zoom_to_tiles(given, _slope(plan, axis)), coefficients
                )
                field = (
                    field + (value - value.detach()) * rate
                )  # adds nothing but the derivative
    return _joined(field, plan)


def _at_depths(fields: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """(tile, depth, Y, X) from fields of the depth basis (tile, X, Y, b)."""
    return (fields @ coefficients.T).permute(0, 3, 2, 1)


def _joined(field: torch.Tensor, plan: WindowPlan) -> torch.Tensor:
    """(depth, y, x) of the window from its tiles (tile, depth, Y, X), each up to where
    the next one begins.
    """
    (rows, columns), _ = window_tiles(plan.case, plan.layout.parts)
    (my, mx), n = plan.case.samples, len(columns)
    heights, widths = np.diff([*rows, my]).tolist(), np.diff([*columns, mx]).tolist()
    bands = [
        torch.cat(
            [field[i * n + j, :, :height, :width] for j, width in enumerate(widths)], -1
        )
        for i, height in enumerate(heights)
    ]
    return torch.cat(bands, -2)


def _coefficients(plan: WindowPlan, moving: MovingGeometry) -> torch.Tensor:
    """(depth, b) of the depth basis, differentiable in the source's position."""
    e, x = (torch.tensor(v) for v in plan.nodes_um)
    ny, nx = plan.layout.sizes.nodes
    inverse = moving.inverse_depths[:, None, None]
    angle = depth_factors(
        plan.case, e[:, None], x, (moving.tangents[0], moving.tangents[1]), inverse
    )
    weight = torch.tensor(
        np.outer(
            legendre.gauss_legendre_nodes(ny)[1], legendre.gauss_legendre_nodes(nx)[1]
        )
    )
    basis = torch.tensor(plan.depths.basis)
    return (torch.exp(1j * angle) * weight).flatten(1) @ basis.flatten(1).conj().T


def zoom_to_tiles(light: torch.Tensor, t: dict[str, torch.Tensor]) -> torch.Tensor:
    """Light on the lens nodes, a field for every tile and basis function (tile, b, e,
    x), to (tile, X, Y, b).

    Args:
        light: (..., y, x) irradiance.
    """
    count, b, e, _ = light.shape
    p, (X, Y) = t["to_directions"].shape[2], t["window_terms"].shape[1:3]
    real = (
        torch.view_as_real(light).permute(0, 2, 1, 4, 3).reshape(count * e, 2 * b, -1)
    )
    cosines = (
        torch.bmm(real, t["to_directions"])
        .view(count, e, b, 2, p)
        .permute(0, 4, 1, 2, 3)
        .contiguous()
    )
    spread = torch.view_as_complex(cosines)
    pairs = len(t["fields"])
    many = max(
        1, int(BUDGET_BYTES / (p * (Y + e) * light.element_size()))
    )  # pairs of one tile at once
    step, few = min(pairs, many), max(1, many // pairs)
    found = []
    for first in range(0, count, few):
        tile = slice(first, first + few)
        out = light.new_zeros((len(spread[tile]), X, Y, b))
        for start in range(0, pairs, step):
            fields = t["fields"][start : start + step]
            terms = t["lens_terms"][tile, ..., start : start + step] * spread[
                tile
            ].index_select(3, fields)
            columns = t["along_y"][tile].flatten(0, 1) @ terms.flatten(0, 1)
            window = (t["along_x"][tile] @ columns.view(len(out), p, -1)).view(
                len(out), X, Y, -1
            )
            out = out.index_add(
                3, fields, window * t["window_terms"][tile, ..., start : start + step]
            )
        found.append(out)
    return torch.cat(found)
