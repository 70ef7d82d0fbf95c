"""RCWA of one unit cell: Jones matrices of any pillar, lattice and layers, refined over
truncations until the error estimate meets a tolerance.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import (
    NARROWEST_SHARE,
    Cell,
    Film,
    Incidence,
    Polarization,
    Response,
    check_tolerance,
    materials,
)
from metalens.cell.shapes import Outline
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa.basis import (
    ROUNDING,
    Operation,
    TangentialWave,
    count_orders,
    plane_waves,
    reduced_orders,
    symmetry_operation,
    tangential_wave,
)
from metalens.rcwa.permittivity import (
    PillarSection,
    pillar_section,
    section_modes,
    staircase_layers,
)
from metalens.rcwa.smatrix import scatter_zero_order

# The error estimate: the largest change from four (six where a gap, wall or hole is
# narrow) earlier truncations, times SAFETY for coarse ones down to 3 from 13 on.
_LAST = {4: 15, 2: 11, 1: 9}  # by the number of symmetry operations: about a second
_LAST_TILTED = {4: 10, 2: 7, 1: 6}  # some thirty layers in place of one
_COMPARED, MOST_COMPARED = 4, 6
SAFETY = 7.0


@dataclass(frozen=True, eq=False, slots=True)
class JonesResponse:
    """Zero-order response of one cell to both polarisations, power-normalised,
    exp(-iwt), incidence from the substrate.

    basis: ("x", "y") at normal incidence, ("s", "p") else, for an azimuth f from +x to
        +y: s is a field along (-sin f, cos f), p one in the plane of incidence whose
        part along the layers lies along (cos f, sin f).
    t, r: (2, 2); column: incident polarisation, row: leaving. (For r, p is taken along
        the same tangential direction as that of the incident light.)
    t_error: estimate of the largest |t - exact| and |r - exact|, not below it.
    energy: (2,) sum of |t|^2 and |r|^2 of all propagating orders, for each incident
        polarisation: 1 without absorption. In an absorbing substrate powers of incident
        and reflected light do not add: it may exceed 1.
    orders: harmonics of the finest truncation. converged, reason: whether the tolerance
        is met, and why the refinement ended.
    earlier: (k, 2, 2) t of up to six earlier truncations, the first of them again where
        fewer are compared. A number that follows from t has as error bar, like t
        itself, ``SAFETY`` times its largest change over them.
    """

    basis: tuple[str, str]
    t: Array
    r: Array
    t_error: float
    energy: Array
    orders: int
    converged: bool
    reason: str
    earlier: Array


@dataclass(frozen=True, slots=True)
class CellProblem:
    """A cell at one size and light, and the symmetry classes of its polarisations.

    indices: refractive, of substrate and cover.
    columns: polarisations to solve, 0: x or s, 1: y or p.
    normals: of each section and film, the outlines of its normal field; none: its own.
    shift: change of width of a cross-section, um, by its diameter; None: none.
    """

    cell: Cell
    size_um: float
    light: TangentialWave
    indices: tuple[complex, complex]
    classes: tuple[tuple[Operation, ...], ...]
    columns: tuple[int, ...] = (0, 1)
    normals: tuple[tuple[Outline, ...], ...] = ()
    shift: Callable[[float], float] | None = None


@dataclass(frozen=True, eq=False, slots=True)
class TruncatedSolution:
    """Solution at one truncation: both: (2, 2, 2) t and r; energy: (2,); wall_error:
    of both, by the staircases of a tilted wall.
    """

    both: Array
    energy: Array
    wall_error: float = 0.0


def cell_problem(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    angle_rad: float,
    azimuth_rad: float,
) -> CellProblem:
    """Check a cell, its size and its light.

    Args:
        cell: the pillar. size_um: of the shape. wavelength_um: in vacuum.
        angle_rad, azimuth_rad: direction of the light.

    Raises:
        CellError: pillars that touch or lose their outline, an impossible angle, no
            zero order.
        MaterialError: a wavelength outside the range of a material.
    """
    light = tangential_wave(wavelength_um, angle_rad, azimuth_rad)
    indices = half_space_indices(cell, light)
    check_size(cell, size_um)
    classes = symmetry_classes(cell, size_um, light)
    return CellProblem(cell, size_um, light, indices, classes)


def half_space_indices(cell: Cell, light: TangentialWave) -> tuple[complex, complex]:
    """Refractive indices of substrate and cover of a ``cell``.

    Raises:
        CellError: no zero order of the ``light`` in the substrate. MaterialError: a
            wavelength outside the range of a material.
    """
    below, above = (
        materials.index(m, light.wavelength_um) for m in (cell.substrate, cell.cover)
    )
    sine = math.hypot(light.kx, light.ky)
    if below.real <= sine:
        raise CellError(
            f"sin(angle_rad) = {sine:.6g} in a substrate of n = {below.real:.6g}: the "
            "light cannot come from there; need a smaller angle_rad or another "
            "substrate"
        )
    return below, above


def stack_sections(
    problem: CellProblem, steps: int
) -> list[tuple[PillarSection, float]]:
    """Films and sections of a pillar, foot first, with heights times k0.

    Args:
        problem: cell and light.
        steps: upright sections into which each one with a tilted wall is cut.
    """
    cell, size_um = problem.cell, problem.size_um
    wavelength_um = problem.light.wavelength_um
    k0 = 2 * math.pi / wavelength_um

    def films(stack: tuple[Film, ...]) -> list[tuple[PillarSection, float]]:
        return [
            (
                PillarSection((), (), materials.index(f.material, wavelength_um) ** 2),
                f.thickness_um * k0,
            )
            for f in stack
        ]

    sections = []
    for layer in staircase_layers(cell, steps):
        moved = problem.shift(size_um + layer.grow_um) if problem.shift else 0.0
        section = pillar_section(cell, layer, size_um, wavelength_um, grow_um=moved)
        sections.append((section, layer.height_um * k0))
    return [*films(cell.under), *sections, *films(cell.over)]


def check_size(cell: Cell, size_um: float) -> None:
    """Raise for sizes at which a section of a ``cell`` vanishes or overlaps its
    neighbour; round pillars may touch, or have no diameter.

    Raises:
        CellError: says where the pillar of ``size_um`` is too wide or too thin.
    """
    least = ">= 0" if cell.round else "above 0"
    if not math.isfinite(size_um) or size_um < 0 or (size_um == 0 and not cell.round):
        raise CellError(f"size = {size_um} um: need a finite length {least}")
    if size_um == 0:
        return
    for layer, grow in cell.tilted_sections:
        for end, share in (("foot", -0.5), ("top", 0.5)):
            width = layer.grow_um + grow + share * cell.width_slope * layer.height_um
            if cell.round and size_um + width < -ROUNDING:
                raise CellError(
                    f"diameter {size_um:g} um: the wall of {cell.sidewall_rad:.4g} rad "
                    f"closes the pillar below its {end}; need at least {-width:.6g} um"
                )
            if cell.round:
                overlaps = size_um + width > cell.pitch_um + ROUNDING
            else:
                grown = width + 2 * layer.coat_um
                overlaps = cell.gap_um(size_um, grow_um=grown) <= 0
            if overlaps:
                raise CellError(
                    f"{cell.described}, size {size_um:g} um: pillars overlap, the "
                    f"{end} of a section, {width:+.4g} um wider, touches its neighbour "
                    f"on a pitch of {cell.pitch_um:g} um; need a smaller size or a "
                    "larger pitch"
                )


def symmetry_classes(
    cell: Cell, size_um: float, light: TangentialWave
) -> tuple[tuple[Operation, ...], ...]:
    """Symmetry operations of the fields: one set for all polarisations, or one for
    each.

    Args:
        cell, size_um: the pillar, whose mirrors count. light: its direction.
    """
    outline = cell.outline(max(size_um, ROUNDING))
    identity, half_turn = symmetry_operation(1, 1), symmetry_operation(-1, -1)
    mirrors = []
    if light.kx == 0 and outline.keeps(-1, 1):
        mirrors.append((-1, 1))
    if light.ky == 0 and outline.keeps(1, -1):
        mirrors.append((1, -1))
    if mirrors:  # light along x has Ex even, light along y odd
        product = (half_turn,) * (len(mirrors) - 1)
        along_x, along_y = (
            tuple(symmetry_operation(*mirror, ex) for mirror in mirrors)
            for ex in (1, -1)
        )
        return (identity, *along_x, *product), (identity, *along_y, *product)
    if light.normal and outline.keeps(-1, -1):
        return ((identity, half_turn),)
    return ((identity,),)


def polarization_column(light: Incidence) -> int:
    """Index of a polarisation in Jones matrices: 0 for x or s, 1 for y or p.

    Args:
        light: at normal incidence p lies along the axis that its azimuth is nearest to.

    Raises:
        CellError: a field along x or y in a plane of incidence off both axes.
    """
    wave = tangential_wave(light.wavelength_um, light.angle_rad, light.azimuth_rad)
    if wave.normal:
        if light.polarization in ("x", "y"):
            return ("x", "y").index(light.polarization)
        turned = round(light.azimuth_rad / (math.pi / 2)) % 2
        return turned if light.polarization == "p" else 1 - turned
    if light.polarization in ("s", "p"):
        return ("s", "p").index(light.polarization)
    if wave.kx and wave.ky:
        raise CellError(
            f"polarization = {light.polarization!r} at angle_rad = {light.angle_rad}, "
            f"azimuth_rad = {light.azimuth_rad}: ambiguous off the axes; need 's' or 'p'"
        )
    return int((wave.ky == 0) == (light.polarization == "x"))


def problem_of_light(cell: Cell, size_um: float, light: Incidence) -> CellProblem:
    """The problem of one polarisation.

    Args:
        cell: the pillar. size_um: of the shape. light: plane wave.

    Raises:
        CellError, MaterialError: as :func:`cell_problem`; an ambiguous polarisation.
    """
    problem = cell_problem(
        cell, size_um, light.wavelength_um, light.angle_rad, light.azimuth_rad
    )
    column = polarization_column(light)
    columns = (0,) if _is_square(problem) else (column,)
    return dataclasses.replace(problem, columns=columns)


def solve(
    cell: Cell,
    diameter_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    polarization: Polarization = "x",
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> Response:
    """Zero-order transmission and reflection of a pillar by RCWA, at the smallest
    truncation that meets the tolerance.

    Args:
        cell: pillar of any shape, lattice, layers and films.
        diameter_um: at half height, 0 (no pillar) to the pitch (touching pillars); of
            another shape its size.
        wavelength_um: in vacuum.
        angle_rad: of the light outside, in vacuum: its tangential wave vector is k0
            sin(angle_rad).
        azimuth_rad: of the plane of incidence, from +x to +y.
        polarization: s or p; x and y where the plane of incidence contains an axis.
        tolerance: bound of |t - exact|. If the largest truncation does not reach it,
            the result has its larger ``t_error`` and ``converged`` False.
        harmonics: fix the largest truncation instead, and take the estimate there.

    Returns:
        Co-polarised amplitudes with their error estimate.

    Raises:
        CellError: an impossible diameter, angle, polarisation or tolerance.
        MaterialError: a wavelength outside the range of a material.

    Accuracy: ``t_error`` follows from the change between truncations. Lossless energy
        and reciprocity hold to rounding.
    """
    check_tolerance(tolerance)
    light = Incidence(
        float(wavelength_um), float(angle_rad), polarization, float(azimuth_rad)
    )
    problem = problem_of_light(cell, float(diameter_um), light)
    column = problem.columns[0]
    jones_response = _refine(problem, tolerance, harmonics)
    return Response(
        complex(jones_response.t[column, column]),
        complex(jones_response.r[column, column]),
        jones_response.t_error,
        jones_response.orders,
        float(jones_response.energy[column]),
        "film" if jones_response.orders == 1 else "rcwa",
        jones_response.converged,
        jones_response.reason,
    )


def jones(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> JonesResponse:
    """Jones matrices of a unit cell by RCWA, at the smallest truncation that meets the
    tolerance.

    Args:
        cell: pillar of any shape, lattice, layers and films.
        size_um: of the shape (what other stages call the diameter).
        wavelength_um: in vacuum.
        angle_rad: of the light outside, in vacuum; azimuth_rad: of the plane of
            incidence, from +x to +y.
        tolerance: bound of |t - exact| and |r - exact|.
        harmonics: fix the largest truncation instead (orders as on a square lattice of
            the same area).

    Raises:
        CellError: pillars that touch or lose their outline, an impossible angle or
            tolerance, no zero order, less than one harmonic.
        MaterialError: a wavelength outside the range of a material.

    Accuracy: ``t_error`` is 3 (from 13 harmonics on) to 7 times the largest change from
        the four truncations before the last (six where pillar or gap is narrow), and
        what the staircases of a tilted wall leave. Corners and high contrast converge
        slowly: 1e-2 is usual.
    """
    check_tolerance(tolerance)
    problem = cell_problem(cell, size_um, wavelength_um, angle_rad, azimuth_rad)
    return _refine(problem, tolerance, harmonics)


def solve_truncation(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    harmonics: int,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    normals_of: tuple[Cell, float] | None = None,
    tolerance: float = 1e-5,
) -> JonesResponse:
    """Jones matrices at one truncation, without an error estimate.

    Args:
        cell, size_um, wavelength_um, angle_rad, azimuth_rad: as for :func:`jones`.
        harmonics: of the truncation.
        normals_of: upright cell and size with as many sections, whose normal field is
            taken. Between pillars that differ little it cancels the noise of the sampling; the
            limit of many harmonics is the same.
        tolerance: of t; a tenth of it is left to the staircase of a tilted wall.
    """
    problem = cell_problem(cell, size_um, wavelength_um, angle_rad, azimuth_rad)
    if normals_of:
        other = dataclasses.replace(problem, cell=normals_of[0], size_um=normals_of[1])
        normals = tuple(section.outlines for section, _ in stack_sections(other, 1))
        problem = dataclasses.replace(problem, normals=normals)
    truncation = solve_problem(problem, harmonics, tolerance)
    return _response(problem, harmonics, truncation, math.inf, False, "one truncation")


@dataclass(frozen=True, slots=True)
class TruncationSequence:
    """Truncations to try, and how their error is estimated.

    reaches: harmonics. compared: number of earlier truncations that the estimate
    compares. factor: on the estimate, for gaps and walls that no truncation resolves.
    """

    reaches: range
    compared: int
    factor: float


def truncation_sequence(
    problem: CellProblem,
    harmonics: int | None,
    *,
    first: int = 3,
    oscillation: float = 0.75,
    thin: float = 1.0,
    touching: float = 5.0,
) -> TruncationSequence:
    """Truncations of one cell and light.

    Args:
        problem: cell and light.
        harmonics: the largest truncation; None: one that takes about a second.
        first: harmonics of the first truncation where four are compared.
        oscillation: errors oscillate once while so many orders fit a narrow width.
        thin, touching: what is added to the factor of the estimate for walls and for
            gaps of no width.

    Raises:
        CellError: less than one harmonic.
    """
    if harmonics is not None and harmonics < 1:
        raise CellError(f"harmonics = {harmonics}: need at least 1")
    cell, size_um = problem.cell, problem.size_um
    if not size_um:
        return TruncationSequence(range(1, 2), 0, 1.0)
    pitch = cell.pitch_um
    if cell.round:
        gap = max(0.0, pitch - size_um)
        spans = np.array([size_um / pitch])
    else:
        gap = cell.gap_um(size_um)
        spans = np.array(cell.outline(size_um).spans_um) / pitch
    # errors oscillate once in 1 / width orders; below NARROWEST_SHARE a factor stands for it
    widths = np.array([gap / pitch, *np.maximum(spans, NARROWEST_SHARE)])
    period = oscillation / widths[widths >= NARROWEST_SHARE].min()
    compared = int(np.clip(math.ceil(period), _COMPARED, MOST_COMPARED))
    last = (
        _largest_truncation(cell, problem.classes) if harmonics is None else harmonics
    )
    start = (first + _COMPARED if harmonics is None else harmonics) - compared
    unresolved_wall = max(0.0, 1 - float(spans.min()) / NARROWEST_SHARE)
    unresolved_gap = max(0.0, 1 - gap / (NARROWEST_SHARE * pitch))
    factor = 1 + max(thin * unresolved_wall, touching * unresolved_gap)
    return TruncationSequence(range(max(1, start), last + 1), compared, factor)


def safety_factor(reach: int) -> float:
    """Factor from the largest change between truncations to the error bar, at ``reach``
    harmonics.
    """
    return 3.0 + 0.6 * max(0, 13 - reach)


def _refine(
    problem: CellProblem, tolerance: float, harmonics: int | None
) -> JonesResponse:
    """Jones matrices of the first truncation that meets the tolerance, or the last.

    A homogeneous cell is solved as a stack of films. The error is that of the
    staircases of tilted walls plus :func:`estimate_error`. While the orders do not
    resolve the pillar, it is at least the pillar's whole effect.

    Args:
        problem: cell and light.
        tolerance: of t and r.
        harmonics: the largest truncation; None: one that takes about a second.
    """
    sequence = truncation_sequence(problem, harmonics)
    film = _film_response(problem)
    if _is_homogeneous(problem):
        k0 = 2 * math.pi / problem.light.wavelength_um
        rounding = ROUNDING * (1 + k0 * problem.cell.height_um)
        return _response(problem, 0, film, rounding, True, "a homogeneous layer: exact")
    history: list[Array] = []
    for reach in sequence.reaches:
        truncation = solve_problem(problem, reach, tolerance)
        history.append(truncation.both)
        error = truncation.wall_error + sequence.factor * estimate_error(
            history, reach, sequence.compared
        )
        if reach * problem.size_um < problem.cell.pitch_um:
            # these orders do not resolve the pillar
            error = max(error, float(np.abs(truncation.both - film.both).max()))
        if len(history) > sequence.compared and error <= tolerance:
            break
    # the exact response is passive
    largest = 1 + max(1.0, float(np.abs(truncation.both).max()))
    error = min(error, largest)
    met = error <= tolerance
    reason = (
        f"orders within {reach}: estimate {'meets' if met else 'above'} the tolerance "
        f"{tolerance:.3g}"
    )
    before = [both[0] for both in history[-1 - sequence.compared : -1]]
    earlier = before[:1] * (MOST_COMPARED - sequence.compared) + before
    return _response(problem, reach, truncation, error, met, reason, earlier)


def estimate_error(history: list[Array], reach: int, compared: int) -> float:
    """Error estimate of the last truncation: :func:`safety_factor` times the largest
    change from the truncations before it.

    Errors fall at least as 1 / reach^2, so that of a change from m to n harmonics
    m^2 / (n^2 - m^2) may be left (all of it at most).

    Args:
        history: results of successive truncations. reach: harmonics of the last.
        compared: how many earlier truncations count.
    """
    earlier = history[-1 - compared : -1][::-1]
    shares = [
        min(1.0, (reach - k) ** 2 / (reach**2 - (reach - k) ** 2))
        for k in range(1, len(earlier) + 1)
    ]
    changes = [
        share * float(np.abs(history[-1] - both).max())
        for share, both in zip(shares, earlier, strict=True)
    ]
    return safety_factor(reach) * max(changes, default=1.0) + ROUNDING


def most_harmonics(
    cell: Cell, size_um: float, *, angle_rad: float = 0.0, azimuth_rad: float = 0.0
) -> int:
    """Largest truncation that :func:`jones` takes by itself: less without mirrors, and
    where walls are tilted.

    Args:
        cell, size_um: the pillar. angle_rad, azimuth_rad: direction of the light.
    """
    light = tangential_wave(1.0, angle_rad, azimuth_rad)
    return _largest_truncation(cell, symmetry_classes(cell, size_um, light))


def _largest_truncation(cell: Cell, classes: tuple[tuple[Operation, ...], ...]) -> int:
    """Harmonics of the largest automatic truncation, by the least number of symmetry
    operations of a class.
    """
    table = _LAST_TILTED if cell.sidewall_rad else _LAST
    return table[min(len(operations) for operations in classes)]


def _is_square(problem: CellProblem) -> bool:
    """Whether x and y are equivalent: both mirrors and a quarter turn, normal
    incidence.
    """
    return (
        len(problem.classes) == 2
        and len(problem.classes[0]) == 4
        and problem.light.normal
        and problem.cell.lattice.kind == "square"
        and problem.cell.is_isotropic
    )


def solve_problem(
    problem: CellProblem,
    reach: int,
    tolerance: float = 1e-5,
    staircases: tuple[int, ...] = (4, 6, 8, 12, 16, 24),
) -> TruncatedSolution:
    """t and r of the problem's polarisations at one truncation.

    A tilted wall is a staircase. Its error is a series in 1 / steps^2, from which
    Richardson's extrapolation takes one term for each further number of steps. The last
    change is the error.

    Args:
        problem: cell and light. reach: harmonics.
        tolerance: of t and r, of which the wall has a tenth.
        staircases: numbers of steps, tried until the extrapolation meets it.
    """
    row: list[Array] = []  # extrapolated amplitudes, of rising order
    for i, steps in enumerate(staircases if problem.cell.sidewall_rad else (1,)):
        sections = stack_sections(problem, steps)
        previous, row = row, [_solve_sections(problem, reach, sections)]
        for k, coarser in enumerate(previous):
            ratio = (steps / staircases[i - 1 - k]) ** 2
            row.append(row[-1] + (row[-1] - coarser) / (ratio - 1))
        error = float(np.abs(row[-1] - previous[-1])[:2].max()) if previous else 0.0
        if previous and error <= tolerance / 10:
            break
    return TruncatedSolution(row[-1][:2], row[-1][2].diagonal().real, error)


def _solve_sections(
    problem: CellProblem, reach: int, sections: list[tuple[PillarSection, float]]
) -> Array:
    """(3, 2, 2) t, r and the energies on a diagonal, of sections that are homogeneous
    along z.

    Each symmetry class is solved by itself: modes of its layers, then the scattering of
    every incident polarisation that it holds.

    Args:
        problem: cell and light. reach: harmonics.
        sections: foot first, with heights times k0.
    """
    cell, size_um, light = problem.cell, problem.size_um, problem.light
    amplitudes = np.zeros((3, 2, 2), complex)
    square = problem.columns == (0, 1) and _is_square(problem)
    columns = (0,) if square else problem.columns
    normals = problem.normals or [section.outlines for section, _ in sections]
    symmetric = cell.outline(max(size_um, ROUNDING)).keeps(-1, -1)
    for operations in problem.classes:
        space = reduced_orders(reach, cell.lattice, operations)
        waves = plane_waves(space, cell, light)
        if not set(columns) & set(waves.zero):
            continue
        modes = [
            section_modes(space, waves, section, cell, height, outlines)
            for (section, height), outlines in zip(sections, normals, strict=True)
        ]
        for column, (incident, sign) in waves.zero.items():
            if column not in columns:
                continue
            scattered = scatter_zero_order(
                waves, problem.indices, modes, incident, symmetric=symmetric
            )
            amplitudes[2, column, column] = scattered.energy
            for row, (leaving, row_sign) in waves.zero.items():
                pair = scattered.t[leaving], scattered.r[leaving]
                amplitudes[:2, row, column] = sign * row_sign * np.array(pair)
    if square:
        amplitudes[:, 1, 1] = amplitudes[:, 0, 0]
    return amplitudes


def _film_response(problem: CellProblem) -> TruncatedSolution:
    """Exact t and r with each section replaced by a film of its surroundings."""
    size_um = problem.size_um or problem.cell.pitch_um / 2
    sized = dataclasses.replace(problem, size_um=size_um)
    films = [
        (PillarSection((), (), section.outside), height)
        for section, height in stack_sections(sized, 1)
    ]
    solution = _solve_sections(problem, 0, films)
    return TruncatedSolution(solution[:2], solution[2].diagonal().real)


def _is_homogeneous(problem: CellProblem) -> bool:
    """Whether the pillar is negligible: contrast times area share times phase, summed
    over the sections, is below rounding.
    """
    if not problem.size_um:
        return True
    cell = problem.cell
    area_um2 = cell.lattice.area_um2(cell.pitch_um)
    share = cell.outline(problem.size_um).area_um2 / area_um2
    effect = sum(
        height * max((abs(eps - section.outside) for eps in section.inside), default=0)
        for section, height in stack_sections(problem, 1)
    )
    return share * effect < ROUNDING


def _response(
    problem: CellProblem,
    reach: int,
    truncation: TruncatedSolution,
    error: float,
    converged: bool,
    reason: str,
    earlier: Sequence[Array] = (),
) -> JonesResponse:
    """Jones response of a truncation, with its basis and number of orders."""
    basis = ("x", "y") if problem.light.normal else ("s", "p")
    t, r = truncation.both
    return JonesResponse(
        basis,
        t,
        r,
        error,
        truncation.energy,
        count_orders(reach),
        converged,
        reason,
        np.array(earlier, complex).reshape(-1, 2, 2),
    )
