"""Tilted walls: u' = i P(z) w, w' = i Q(z) u by Gauss collocation, of high order in z."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from metalens.cell import Cell, Layer
from metalens.core.arrays import Array
from metalens.rcwa.permittivity import PillarSection, pillar_section
from metalens.rcwa.smatrix import Pair, TangentialFields

Sample = Callable[[float], tuple[Array, Array]]
# ends of the panels as shares of the height: shorter towards foot and top
EDGES = (0.0, 0.025, 0.09, 0.26, 0.5, 0.74, 0.91, 0.975, 1.0)
FEWEST, MOST = 4, 10  # Gauss points: 4 leave 2e-3 of t, each more a hundredth of that
_NODES = 8  # cross-sections through which the polynomial of a tilted section runs


@dataclass(frozen=True, slots=True)
class WallSection:
    """One section of a pillar.

    sample: P and Q at a share of its height, 0 at its foot. reduced_height: times k0.
    """

    sample: Sample
    reduced_height: float


def wall_sections(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    operators: Callable[[PillarSection, int], tuple[Array, Array]],
    shift: Callable[[float], float] | None = None,
) -> list[WallSection]:
    """Sections of a pillar, foot first; of tilted ones P and Q are polynomials through
    Chebyshev points of the height.

    Args:
        cell, size_um: the pillar. wavelength_um: in vacuum.
        operators: P and Q of a cross-section, and the number of its section.
        shift: additional width of a cross-section, by its diameter.
    """

    def section(i: int, layer: Layer, grow_um: float) -> WallSection:
        def sample(share: float) -> tuple[Array, Array]:
            width = grow_um + (share - 0.5) * width_slope(cell) * layer.height_um
            if shift:
                width += float(shift(size_um + width))
            cross_section = pillar_section(
                cell, layer, size_um, wavelength_um, grow_um=width
            )
            return operators(cross_section, i)

        height = layer.height_um * 2 * math.pi / wavelength_um
        return WallSection(
            _interpolated(sample) if cell.sidewall_rad else sample, height
        )

    return [
        section(i, layer, grow_um)
        for i, (layer, grow_um) in enumerate(sections_with_growth(cell))
    ]


def _interpolated(sample: Sample) -> Sample:
    """P and Q at any height, from polynomials through ``_NODES`` Chebyshev points.

    The values at the points are computed on the first call and cached.
    """
    chebvander = np.polynomial.chebyshev.chebvander
    nodes = -np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    inverse = np.linalg.inv(chebvander(nodes, _NODES - 1))

    @functools.cache
    def values() -> tuple[Array, Array]:
        P, Q = zip(*(sample((1 + float(x)) / 2) for x in nodes), strict=True)
        return np.stack(P), np.stack(Q)

    def at(share: float) -> tuple[Array, Array]:
        weights = (chebvander(np.array([2 * share - 1]), _NODES - 1) @ inverse)[0]
        P, Q = (np.tensordot(weights, part, 1) for part in values())
        return P, Q

    return at


def width_slope(cell: Cell) -> float:
    """Change of width for each um of height of a ``cell`` with tilted walls."""
    return -2 * math.tan(cell.sidewall_rad)


def sections_with_growth(cell: Cell) -> list[tuple[Layer, float]]:
    """Sections of a ``cell``, foot first, with the widening at the middle of each by
    the tilted wall, um.
    """
    sections, foot = [], -cell.height_um / 2
    for layer in cell.sections:
        sections.append((layer, width_slope(cell) * (foot + layer.height_um / 2)))
        foot += layer.height_um
    return sections


def staircase_layers(cell: Cell, steps: int) -> list[Layer]:
    """Staircase approximation: the sections of a ``cell``, each of a tilted wall cut
    into ``steps`` upright ones of equal height.
    """
    count = steps if cell.sidewall_rad else 1
    layers = []
    for layer, grow in sections_with_growth(cell):
        step_um = layer.height_um / count
        for i in range(count):
            step_growth = (i + 0.5 - count / 2) * step_um * width_slope(cell)
            width = layer.grow_um + grow + step_growth
            layers.append(replace(layer, height_um=step_um, grow_um=width))
    return layers


@functools.lru_cache(maxsize=8)
def gauss_collocation(stages: int) -> tuple[Array, Array, Array]:
    """Gauss points c (m,), weights b (m,) and integrals a (m, m) of the Lagrange
    polynomials on [0, 1], for m = ``stages``.
    """
    x, w = np.polynomial.legendre.leggauss(stages)
    c = (x + 1) / 2
    powers = np.arange(stages)
    integrals = c[:, None] ** (powers + 1) / (powers + 1)
    return c, w / 2, np.linalg.solve(np.vander(c, increasing=True).T, integrals.T).T


def panel_transfer(section: WallSection, low: float, high: float, stages: int) -> Array:
    """(2 n, 2 n) transfer matrix of (u, w) from the upper to the lower end of a panel.

    Gauss collocation of u' = i P w, w' = i Q u, with the stage values of u eliminated
    from one linear system.

    Args:
        section: of the wall. low, high: ends of the panel, shares of the height.
        stages: number of Gauss points.
    """
    c, b, a = gauss_collocation(stages)
    samples = [section.sample(float(high - x * (high - low))) for x in c]
    P, Q = (np.stack(matrices) for matrices in zip(*samples, strict=True))
    step = -1j * section.reduced_height * (high - low)
    n = P.shape[-1]

    def stage_integrals(matrices: Array) -> Array:
        blocks = a[:, None, :, None] * matrices.transpose(1, 0, 2)[None]
        return np.asarray(blocks.reshape(stages * n, stages * n))

    p, q = stage_integrals(P), stage_integrals(Q)
    identities = np.tile(np.eye(n), (stages, 1))
    # u = u_0 + step p w, with w = w_0 + step q u inserted
    right_side = np.concatenate([identities, step * (p @ identities)], axis=1)
    u = np.linalg.solve(np.eye(stages * n) - step**2 * (p @ q), right_side)
    w = np.concatenate([np.zeros_like(identities), identities], axis=1) + step * (q @ u)
    transfer = np.eye(2 * n, dtype=complex)
    for rows, matrices, field in ((slice(n), P, w), (slice(n, None), Q, u)):
        stage_fields = field.reshape(stages, n, -1)
        transfer[rows] += step * np.einsum(
            "k,kij,kjl->il", b, matrices, stage_fields, optimize=True
        )
    return transfer


def match_walls(
    sections: Sequence[WallSection],
    top: Pair,
    foot: Pair,
    source: Array,
    *,
    stages: int,
) -> TangentialFields:
    """As :func:`metalens.rcwa.smatrix.match_layers`, for tilted walls.

    Args:
        sections: foot first. top, foot: diagonal pairs above and below.
        source: (n,). stages: Gauss points of every panel.
    """
    n = len(source)
    pair = np.concatenate([np.diag(side) for side in top])
    scales = []
    for section in reversed(sections):
        for low, high in zip(EDGES[-2::-1], EDGES[:0:-1], strict=True):
            transfer = panel_transfer(section, low, high, stages)
            pair, scale = np.linalg.qr(transfer @ pair)
            scales.append(scale)
    U, V = pair[:n], pair[n:]
    a = np.linalg.solve(foot[1][:, None] * U + foot[0][:, None] * V, source)
    u, w = U @ a, V @ a
    for scale in reversed(scales):
        a = np.linalg.solve(scale, a)
    return TangentialFields(u, w, top[0] * a, top[1] * a, [], [])


def choose_stage_count(
    respond_at: Callable[[int], Array], tolerance: float
) -> tuple[int, float]:
    """Fewest Gauss points with an error below a tenth of the tolerance, and that error.

    The error is the change of t and r by the last point added.

    Args:
        respond_at: t and r with this many points. tolerance: of t and r.
    """
    stages, amplitudes = FEWEST, respond_at(FEWEST)
    while True:
        finer = respond_at(stages + 1)
        change = float(np.abs(finer - amplitudes).max())
        stages, amplitudes = stages + 1, finer
        if change <= tolerance / 10 or stages >= MOST:
            return stages, change
