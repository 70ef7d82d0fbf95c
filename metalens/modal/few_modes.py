"""The modes that carry light over a layer, and everything else in one matrix root.

The diagonal blocks of the layer's equation are diagonalised (``LayerPencil``);
Davidson's method finds the few eigenvectors.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.modal.dense import (
    add_diagonal,
    cholesky_factor,
    definite_inverse,
    gram_matrix,
    solve_lower,
    symmetric_eigenvectors,
    whitened_levels,
)
from metalens.modal.layer import LayerMedium, axial_wavenumber
from metalens.modal.spaces import HomogeneousBasis

# levels are diagonalised up to this multiple of the largest contribution of the
# permittivities to the diagonal
LOW = 32.0
SPARE = (
    3.0  # low levels reach this many times the level of the weakest mode that carries
)
EXTRA = 60.0  # and this much further
ROUNDS = 6  # of enlarging the low levels, at most
STEPS = 80  # of the fixed point, at most
WHOLE = 1  # of them on all rows, at the start
ROUNDING = 1e-14  # of the largest element
# change of the slow rows, over that of the last full step, below which a full step
# follows
SETTLED = 0.03
SLOW = 8  # the rows of the lowest eighth of the levels go on alone
# accuracy in single precision, relative to the lowest level; rounding is 1e-7 of it
ROUGH = 3e-7
# single precision suffices from this accuracy on: results change by 7e-8 on coarse
# meshes, by 4e-3 of the error bar on fine ones
SINGLE = 3e-8
STRIPS = 4  # of rows of a product whose other half is a mirror image


@dataclass(frozen=True, eq=False, slots=True)
class CoordinateTurn:
    """Fields of y in the homogeneous basis, square: of the first alone ``low`` (m, m),
    of each other ``beyond`` times
    itself; size: of all."""

    low: np.ndarray
    size: int
    beyond: float = 1.0

    def apply_transposed(self, matrix: np.ndarray) -> np.ndarray:
        """turnᵀ matrix."""
        m = len(self.low)
        if m == self.size:
            return np.asarray(self.low.T @ matrix)
        out = matrix * self.beyond
        out[:m] = self.low.T @ matrix[:m]
        return out

    def add_congruence(self, block: np.ndarray, diagonal: np.ndarray) -> None:
        """Add turnᵀ diagonal turn to a ``block``, in place."""
        m = len(self.low)
        block[:m, :m] += self.low.T @ (diagonal[:m, None] * self.low)
        beyond = np.arange(m, self.size)
        block[beyond, beyond] += self.beyond**2 * diagonal[m:]

    def take_rows(self, places: np.ndarray) -> np.ndarray:
        """Its rows at ``places``."""
        m = len(self.low)
        out = np.zeros((len(places), self.size))
        for row, place in zip(out, places.tolist(), strict=True):
            if place < m:
                row[:m] = self.low[place]
            else:
                row[place] = self.beyond
        return out


@dataclass(frozen=True, eq=False, slots=True)
class LayerPencil:
    """Real and symmetric; see the module.

    te (a,), tm (b,): levels. te_sign, tm_sign: of growth. coupling: (a, b).
    te_turn, tm_turn: fields of the y in the homogeneous basis. dual: the unknown is the
    partner.
    te_rest (a, a) or tm_rest (b, b): off-diagonal part of growth⁻¹ stiffness, zero
    between the low levels; the other None.
    """

    te: np.ndarray
    tm: np.ndarray
    te_sign: np.ndarray
    tm_sign: np.ndarray
    coupling: np.ndarray
    te_turn: CoordinateTurn
    tm_turn: CoordinateTurn
    te_rest: np.ndarray | None
    tm_rest: np.ndarray | None
    dual: bool


def is_lossless(medium: LayerMedium) -> bool:
    """Whether a ``medium`` has positive real permittivities, as the definite blocks
    need.
    """
    return all(
        e.imag == 0 and e.real > 0 for e in map(complex, (medium.disc, medium.around))
    )


def low_levels(
    matrix: np.ndarray, square: np.ndarray, most: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Partial diagonalisation of a symmetric matrix: its low block exactly.

    Args:
        matrix: (n, n), diag(square) plus a perturbation; its lower triangle counts.
        square: (n,) ascending. most: size of the perturbation.

    Returns:
        Levels (n,), vectors (m, m) of the low levels, and the coupling (n, n) of the
        other levels in the new basis.
    """
    m, n = max(1, int(np.searchsorted(square, LOW * most))), len(square)
    low, vectors = symmetric_eigenvectors(matrix[:m, :m])
    level = np.concatenate([low, matrix.diagonal()[m:]])
    coupling = np.zeros((n, n))
    coupling[m:, :m] = matrix[m:, :m] @ vectors
    coupling[m:, m:] = np.tril(matrix[m:, m:], -1)
    return level, vectors, coupling + coupling.T


def electric_pencil(basis: HomogeneousBasis, medium: LayerMedium) -> LayerPencil:
    """Block-diagonalised equation of the layer for u = E_t: growth = diag(1,
    (scalar_eps^-1 tm / k0^2 - 1)^-1 negative), stiffness = curl - k0^2 mass_eps.

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities, lossless.
    """
    around = float(medium.around.real)
    te_count = len(basis.te)
    tm_count = len(basis.tm)
    k2 = medium.k0**2
    contrast = float((medium.disc - medium.around).real)
    te_block = add_diagonal(
        -k2 * contrast * basis.disc_mass[:te_count, :te_count], basis.te - k2 * around
    )
    te, te_low, te_coupling = low_levels(te_block, basis.te, k2 * abs(contrast))
    tm_block = add_diagonal(
        k2 * contrast * basis.disc_mass[te_count:, te_count:], k2 * around
    )
    scalar = cholesky_factor(add_diagonal(contrast * basis.disc_scalar, around))
    whitened = solve_lower(scalar, np.diag(np.sqrt(basis.tm / k2)))
    tm, tm_turn = whitened_levels(tm_block, add_diagonal(gram_matrix(whitened), -1.0))
    turn = CoordinateTurn(te_low, te_count)
    coupling = turn.apply_transposed(
        -k2 * contrast * basis.disc_mass[:te_count, te_count:] @ tm_turn
    )
    return LayerPencil(
        te,
        tm,
        np.ones(te_count),
        -np.sign(tm),
        coupling,
        turn,
        CoordinateTurn(tm_turn, tm_count),
        te_coupling,
        None,
        dual=False,
    )


def magnetic_pencil(basis: HomogeneousBasis, medium: LayerMedium) -> LayerPencil:
    """Block-diagonalised equation of the layer for the dual unknown of u = H_t: growth
    = stiffness^-1, stiffness = mass_(1/eps)^-1 - diag(0, tm / k0^2).

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities, lossless.
    """
    disc, around = (1 / float(e.real) for e in (medium.disc, medium.around))
    te_count, tm_count, k2 = len(basis.te), len(basis.tm), medium.k0**2
    weighted = definite_inverse(add_diagonal((disc - around) * basis.disc_mass, around))
    curl = add_diagonal((disc - around) * basis.disc_curl, around * basis.te - k2)
    te, te_turn = whitened_levels(weighted[:te_count, :te_count], curl)
    tm_block = add_diagonal(-k2 * weighted[te_count:, te_count:], basis.tm)
    tm, tm_low, tm_coupling = low_levels(
        tm_block, basis.tm, k2 * abs(1 / disc - 1 / around)
    )
    turn = CoordinateTurn(tm_low * medium.k0, tm_count, medium.k0)
    coupling = turn.apply_transposed(weighted[te_count:, :te_count] @ te_turn).T
    return LayerPencil(
        te,
        tm,
        np.sign(te),
        -np.ones(tm_count),
        coupling,
        CoordinateTurn(te_turn, te_count),
        turn,
        None,
        tm_coupling,
        dual=True,
    )


@dataclass(frozen=True, eq=False, slots=True)
class FewModes:
    """Modes that carry, in the coordinates y of the pencil, and the rest.

    q: (c,) axial wavenumbers. field, partner: (n, c), partner = growth field. near: (n,
    n) real admittance of the
    layer without end, with ``near_rate`` in place of i q for the modes that carry.
    """

    q: np.ndarray
    field: np.ndarray
    partner: np.ndarray
    near: np.ndarray
    near_rate: float


@dataclass(frozen=True, eq=False, slots=True)
class RitzVectors:
    """Orthonormal trial vectors (levels, vectors) of both blocks, and the signs of
    growth on them.
    """

    te: np.ndarray
    tm: np.ndarray
    te_sign: np.ndarray
    tm_sign: np.ndarray


def solve_ritz(
    pencil: LayerPencil, trial: RitzVectors, height: float, weak: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rayleigh-Ritz values (-q^2) and vectors of the modes that carry.

    Args:
        pencil: of the layer. trial: orthonormal vectors of both blocks.
        height: of the layer. weak: modes weaker than this over the height are left out.

    Returns:
        Levels (c,) and vectors (a, c), (b, c).
    """
    te_count = trial.te.shape[1]
    sign = np.concatenate([trial.te_sign, trial.tm_sign])
    matrix = np.zeros((len(sign), len(sign)))
    matrix[:te_count, :te_count] = trial.te.T @ (
        pencil.te_sign[:, None] * apply_shifted(pencil.te, pencil.te_rest, trial.te)
    )
    matrix[te_count:, te_count:] = trial.tm.T @ (
        pencil.tm_sign[:, None] * apply_shifted(pencil.tm, pencil.tm_rest, trial.tm)
    )
    matrix[:te_count, te_count:] = trial.te.T @ (pencil.coupling @ trial.tm)
    matrix[te_count:, :te_count] = matrix[:te_count, te_count:].T
    level, vectors = np.linalg.eig(sign[:, None] * matrix)
    carry = np.flatnonzero(
        np.abs(np.exp(1j * axial_wavenumber(-level) * height)) > weak
    )
    return (
        level[carry],
        trial.te @ vectors[:te_count, carry],
        trial.tm @ vectors[te_count:, carry],
    )


def apply_shifted(
    level: np.ndarray, rest: np.ndarray | None, vectors: np.ndarray
) -> np.ndarray:
    """(diag(level) + rest) vectors."""
    out: np.ndarray = level[:, None] * vectors
    if rest is not None:
        out += rest @ vectors
    return out


def enlarge_trial_space(
    trial: np.ndarray,
    sign: np.ndarray,
    low: np.ndarray,
    residual: np.ndarray,
    high: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Davidson step: add the directions of the residual to the trial space of a block.

    Only components outside the low levels and the trial space count, with singular
    values above 1e-3 of the largest.

    Args:
        trial, sign: vectors, and signs of growth on them. low: levels in the first
            space.
        residual: (n, c). high: sign of growth outside the low levels.
    """
    directions = (
        np.concatenate([residual.real, residual.imag], 1)
        if np.iscomplexobj(residual)
        else residual.copy()
    )
    directions[low] = 0.0
    directions -= trial @ (trial.T @ directions)
    left, value, _ = np.linalg.svd(directions, full_matrices=False)
    added = (
        left[:, value > 1e-3 * value[0]] if value.size and value[0] > 0 else left[:, :0]
    )
    return np.concatenate([trial, added], 1), np.concatenate(
        [sign, np.full(added.shape[1], high)]
    )


def carrying_modes(
    pencil: LayerPencil, height: float, weak: float, accuracy: float
) -> tuple[np.ndarray, ...] | None:
    """Levels and vectors of the modes that carry light, by Davidson's method.

    Each round solves the Rayleigh-Ritz problem on the trial space. The residuals of the
    high levels, divided by (diagonal - level), enlarge the space until they are
    negligible.

    Args:
        pencil: of the layer, of this ``height``. weak: as in :func:`few_modes`.
        accuracy: of the vectors, relative.

    Returns:
        Levels (c,), vectors (a, c) and (b, c); None if the modes are too many.
    """
    reach = SPARE * (math.log(weak) / height) ** 2 + EXTRA
    low_te, low_tm = pencil.te < reach, pencil.tm < reach
    high_te, high_tm = ~low_te, ~low_tm
    low_count = np.count_nonzero(low_te) + np.count_nonzero(low_tm)
    if (
        low_count > 0.5 * (len(pencil.te) + len(pencil.tm))
        or (pencil.te_sign[~low_te] < 0).any()
    ):
        return None
    trial = RitzVectors(
        np.eye(len(pencil.te))[:, low_te],
        np.eye(len(pencil.tm))[:, low_tm],
        pencil.te_sign[low_te],
        pencil.tm_sign[low_tm],
    )
    for _ in range(ROUNDS):
        level, te, tm = solve_ritz(pencil, trial, height, weak)
        change_te, change_tm = np.zeros_like(te), np.zeros_like(tm)
        coupled = pencil.coupling[high_te] @ tm
        if pencil.te_rest is not None:
            coupled += pencil.te_rest[high_te] @ te
        change_te[high_te] = te[high_te] + coupled / (pencil.te[high_te, None] - level)
        coupled = pencil.tm_sign[high_tm, None] * (pencil.coupling[:, high_tm].T @ te)
        if pencil.tm_rest is not None:
            coupled += pencil.tm_rest[high_tm] @ tm
        change_tm[high_tm] = tm[high_tm] + coupled / (pencil.tm[high_tm, None] - level)
        if (
            max(np.abs(change_te).max(initial=0.0), np.abs(change_tm).max(initial=0.0))
            < accuracy
        ):
            return level, te, tm
        te_block = enlarge_trial_space(trial.te, trial.te_sign, low_te, change_te, 1.0)
        tm_block = enlarge_trial_space(trial.tm, trial.tm_sign, low_tm, change_tm, -1.0)
        trial = RitzVectors(te_block[0], tm_block[0], te_block[1], tm_block[1])
        if len(trial.te_sign) + len(trial.tm_sign) > 0.8 * (
            len(pencil.te) + len(pencil.tm)
        ):
            return None
    return None


def matrix_root(
    square: np.ndarray, signs: np.ndarray, least: float, accuracy: float
) -> np.ndarray | None:
    """Matrix square root X with eigenvalues in the right half plane; None if the
    iteration does not converge.

    X = D + E, D the root of the diagonal. (D_i + D_j) E_ij + (E²)_ij = (X² - D²)_ij is
    solved by :func:`fixed_point`, first in single precision.

    Args:
        square: X². signs: of growth, with respect to which it is symmetric.
        least: levels of the diagonal below it are raised to it.
        accuracy: relative, of the result.
    """
    n = len(square)
    diagonal = np.sqrt(np.maximum(np.diag(square), least))
    order = np.argsort(diagonal)
    diagonal, ordered = diagonal[order], signs[order]
    weight = 1 / (diagonal[:, None] + diagonal)
    offset = square.take(order, 0).take(order, 1) * weight
    offset.ravel()[:: n + 1] -= diagonal / 2
    limit = max(accuracy * diagonal[0], ROUNDING * diagonal[-1])
    single = offset.astype(np.float32), weight.astype(np.float32)
    rough_root = fixed_point(
        single[0], single, ordered, max(limit, ROUGH * diagonal[0]), whole=WHOLE
    )
    correction = None if rough_root is None else rough_root.astype(float)
    if correction is not None and accuracy < SINGLE:
        correction = fixed_point(correction, (offset, weight), ordered, limit, whole=1)
    if correction is None:
        return None
    correction.ravel()[:: n + 1] += diagonal
    inverse_order = np.argsort(order)
    return np.asarray(correction.take(inverse_order, 0).take(inverse_order, 1))


def fixed_point(
    e: np.ndarray,
    fixed: tuple[np.ndarray, np.ndarray],
    signs: np.ndarray,
    aim: float,
    *,
    whole: int,
) -> np.ndarray | None:
    """Fixed point E = offset - weight * E²; None if the steps do not shrink.

    The rows of the lowest levels converge last. After ``whole`` full steps they iterate
    alone; a full step follows when they move by less than a share of the last one's
    change. The result is accepted when a full step moves them by less than ``aim``.

    Args:
        e: start value. fixed: (offset, weight). signs: of growth.
        aim: limit of the change. whole: full steps before the slow rows iterate alone.
    """
    offset, weight = fixed
    slow = max(1, len(e) // SLOW)
    mirror = (signs[:slow] * signs[:, None]).astype(e.dtype)
    change, first, last = np.inf, np.inf, np.inf
    for step in range(STEPS):
        if step < whole or change < max(aim, SETTLED * last):
            new_e = symmetric_square(e, signs)
            new_e *= weight
            np.subtract(offset, new_e, out=new_e)
            last = change = float(np.abs(new_e[:slow] - e[:slow]).max())
            e = new_e
            if change < aim:
                return symmetrize_by_signs(e, signs)
        else:
            rows = e[:slow] @ e
            rows *= weight[:slow]
            np.subtract(offset[:slow], rows, out=rows)
            change = float(np.abs(rows - e[:slow]).max())
            e[:slow], e[:, :slow] = rows, mirror * rows.T
        first = change if step == 0 else first
        if not change <= 2 * first:
            return None
    return None


def symmetrize_by_signs(e: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Matrix ``e``, made symmetric with respect to the ``signs`` to the last bit.

    Products on some processors are not symmetric, and an asymmetry loses energy.
    """
    mirror = (signs[:, None] * signs).astype(e.dtype) * e.T
    return np.asarray((e + mirror) / 2)


def symmetric_square(e: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """e @ e of a matrix that is symmetric with respect to the signs.

    Strips of rows are computed from the diagonal on; the others are mirror images.
    """
    n, product = len(e), np.empty_like(e)
    for start in range(0, n, -(-n // STRIPS)):
        rows = slice(start, start - (-n // STRIPS))
        columns = slice(start - (-n // STRIPS), n)
        product[rows, start:] = e[rows] @ e[:, start:]
        product[columns, rows] = (signs[columns, None] * signs[rows]).astype(
            e.dtype
        ) * product[rows, columns].T
    return product


def few_modes(pencil: LayerPencil, height: float, *, weak: float) -> FewModes | None:
    """Modes of a layer that carry light over its height, and the admittance of the
    rest; None where they are not few.

    Args:
        pencil: of the layer. height: in half pitches.
        weak: relative accuracy; modes weaker than this are left out.
    """
    carrying = carrying_modes(pencil, height, weak, 0.1 * math.sqrt(weak))
    if carrying is None:
        return None
    level, te, tm = carrying
    te_count = len(pencil.te)
    sign = np.concatenate([pencil.te_sign, pencil.tm_sign])
    field = np.concatenate([te, tm])
    partner = sign[:, None] * field
    square = np.zeros((len(sign), len(sign)))
    square.ravel()[:: len(sign) + 1] = np.concatenate([pencil.te, pencil.tm])
    square[:te_count, te_count:] = pencil.te_sign[:, None] * pencil.coupling
    square[te_count:, :te_count] = pencil.tm_sign[:, None] * pencil.coupling.T
    if pencil.te_rest is not None:
        square[:te_count, :te_count] += pencil.te_rest
    if pencil.tm_rest is not None:
        square[te_count:, te_count:] += pencil.tm_rest
    common = max(float(np.abs(level).max(initial=0.0)), 1.0)
    norm = np.einsum("ij,ij->j", partner, field)
    square += ((field * ((common - level) / norm)) @ partner.T).real
    root = matrix_root(square, sign, common, weak)
    if root is None:
        return None
    return FewModes(
        axial_wavenumber(-level),
        field,
        partner,
        -sign[:, None] * root,
        -np.sqrt(common),
    )
