"""The modes that carry light over a layer, and everything else in one matrix root.

The diagonal blocks of the layer's equation are diagonalised (``LayerPencil``); Davidson's
method finds the few eigenvectors.
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
from metalens.modal.homogeneous import HomogeneousBasis
from metalens.modal.layer import LayerMedium, axial_wavenumber

# levels up to this many times the most that permittivities add to a diagonal are
# diagonalised
LOW = 32.0
SPARE = (
    3.0  # low levels reach this many times the level of the weakest mode that carries
)
EXTRA = 60.0  # and this much further
ROUNDS = 6  # of enlarging the low levels, at most
STEPS = 80  # of the fixed point, at most
WHOLE = 1  # of them on all rows, before
ROUNDING = 1e-14  # of the largest element
# change of the slow rows, in that of the last whole step, at which all rows move again
SETTLED = 0.03
SLOW = 8  # the rows of the lowest eighth of the levels go on alone
# of the lowest level: what single precision is asked for, where rounding leaves 1e-7 of
# it
ROUGH = 3e-7
# accuracies from it on are met by that: answers move by 7e-8 on coarse meshes, 4e-3 of
# a bar on good
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
    te_rest (a, a) or tm_rest (b, b): of growth⁻¹ stiffness beside the levels, zero
    among the low ones; the other None.
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
    """Whether a ``medium`` has positive real permittivities, as the definite blocks need."""
    return all(
        e.imag == 0 and e.real > 0 for e in map(complex, (medium.disc, medium.around))
    )


def low_levels(
    matrix: np.ndarray, square: np.ndarray, most: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels (n,), vectors (m, m) of the low ones, and what is left, of diag(square)
    and as much as ``most`` beside it.

    square: rising. Of the matrix the lower triangle counts.
    """
    m, n = max(1, int(np.searchsorted(square, LOW * most))), len(square)
    low, vectors = symmetric_eigenvectors(matrix[:m, :m])
    level = np.concatenate([low, matrix.diagonal()[m:]])
    rest = np.zeros((n, n))
    rest[m:, :m] = matrix[m:, :m] @ vectors
    rest[m:, m:] = np.tril(matrix[m:, m:], -1)
    return level, vectors, rest + rest.T


def electric_pencil(basis: HomogeneousBasis, medium: LayerMedium) -> LayerPencil:
    """Block-diagonalised equation of the layer for u = E_t: growth = diag(1, (scalar_eps^-1
    tm / k0^2 - 1)^-1 negative), stiffness = curl - k0^2 mass_eps.

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities, lossless.
    """
    around = float(medium.around.real)
    a = len(basis.te)
    b = len(basis.tm)
    k2 = medium.k0**2
    step = float((medium.disc - medium.around).real)
    first = add_diagonal(-k2 * step * basis.disc_mass[:a, :a], basis.te - k2 * around)
    te, te_low, rest = low_levels(first, basis.te, k2 * abs(step))
    second = add_diagonal(k2 * step * basis.disc_mass[a:, a:], k2 * around)
    scalar = cholesky_factor(add_diagonal(step * basis.disc_scalar, around))
    rise = solve_lower(scalar, np.diag(np.sqrt(basis.tm / k2)))
    tm, tm_turn = whitened_levels(second, add_diagonal(gram_matrix(rise), -1.0))
    turn = CoordinateTurn(te_low, a)
    coupling = turn.apply_transposed(-k2 * step * basis.disc_mass[:a, a:] @ tm_turn)
    return LayerPencil(
        te,
        tm,
        np.ones(a),
        -np.sign(tm),
        coupling,
        turn,
        CoordinateTurn(tm_turn, b),
        rest,
        None,
        dual=False,
    )


def magnetic_pencil(basis: HomogeneousBasis, medium: LayerMedium) -> LayerPencil:
    """Block-diagonalised equation of the layer for the dual unknown of u = H_t: growth =
    stiffness^-1, stiffness = mass_(1/eps)^-1 - diag(0, tm / k0^2).

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities, lossless.
    """
    disc, around = (1 / float(e.real) for e in (medium.disc, medium.around))
    a, b, k2 = len(basis.te), len(basis.tm), medium.k0**2
    weighted = definite_inverse(add_diagonal((disc - around) * basis.disc_mass, around))
    curl = add_diagonal((disc - around) * basis.disc_curl, around * basis.te - k2)
    te, te_turn = whitened_levels(weighted[:a, :a], curl)
    second = add_diagonal(-k2 * weighted[a:, a:], basis.tm)
    tm, tm_low, rest = low_levels(second, basis.tm, k2 * abs(1 / disc - 1 / around))
    turn = CoordinateTurn(tm_low * medium.k0, b, medium.k0)
    coupling = turn.apply_transposed(weighted[a:, :a] @ te_turn).T
    return LayerPencil(
        te,
        tm,
        np.sign(te),
        -np.ones(b),
        coupling,
        CoordinateTurn(te_turn, a),
        turn,
        None,
        rest,
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
    k = trial.te.shape[1]
    sign = np.concatenate([trial.te_sign, trial.tm_sign])
    matrix = np.zeros((len(sign), len(sign)))
    matrix[:k, :k] = trial.te.T @ (
        pencil.te_sign[:, None] * apply_shifted(pencil.te, pencil.te_rest, trial.te)
    )
    matrix[k:, k:] = trial.tm.T @ (
        pencil.tm_sign[:, None] * apply_shifted(pencil.tm, pencil.tm_rest, trial.tm)
    )
    matrix[:k, k:] = trial.te.T @ (pencil.coupling @ trial.tm)
    matrix[k:, :k] = matrix[:k, k:].T
    level, vectors = np.linalg.eig(sign[:, None] * matrix)
    carry = np.flatnonzero(
        np.abs(np.exp(1j * axial_wavenumber(-level) * height)) > weak
    )
    return level[carry], trial.te @ vectors[:k, carry], trial.tm @ vectors[k:, carry]


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
    """Davidson step: the trial space of one block with the directions of the residual
    outside the low levels added.

    Args:
        trial, sign: vectors, and signs of growth on them. low: levels in the first space.
        residual: (n, c). high: sign of growth outside the low levels.
    """
    real = (
        np.concatenate([residual.real, residual.imag], 1)
        if np.iscomplexobj(residual)
        else residual.copy()
    )
    real[low] = 0.0
    real -= trial @ (trial.T @ real)
    left, value, _ = np.linalg.svd(real, full_matrices=False)
    more = (
        left[:, value > 1e-3 * value[0]] if value.size and value[0] > 0 else left[:, :0]
    )
    return np.concatenate([trial, more], 1), np.concatenate(
        [sign, np.full(more.shape[1], high)]
    )


def carrying_modes(
    pencil: LayerPencil, height: float, weak: float, accuracy: float
) -> tuple[np.ndarray, ...] | None:
    """Levels and vectors of the modes that carry, by Davidson's method; None where they
    are too many to be few.

    Args:
        pencil: of the layer, of this ``height``. weak: as in :func:`few_modes`.
        accuracy: of the vectors, relative.
    """
    reach = SPARE * (math.log(weak) / height) ** 2 + EXTRA
    low_te, low_tm = pencil.te < reach, pencil.tm < reach
    high_te, high_tm = ~low_te, ~low_tm
    few = np.count_nonzero(low_te) + np.count_nonzero(low_tm)
    if (
        few > 0.5 * (len(pencil.te) + len(pencil.tm))
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
        off_te, off_tm = np.zeros_like(te), np.zeros_like(tm)
        pull = pencil.coupling[high_te] @ tm
        if pencil.te_rest is not None:
            pull += pencil.te_rest[high_te] @ te
        off_te[high_te] = te[high_te] + pull / (pencil.te[high_te, None] - level)
        pull = pencil.tm_sign[high_tm, None] * (pencil.coupling[:, high_tm].T @ te)
        if pencil.tm_rest is not None:
            pull += pencil.tm_rest[high_tm] @ tm
        off_tm[high_tm] = tm[high_tm] + pull / (pencil.tm[high_tm, None] - level)
        if (
            max(np.abs(off_te).max(initial=0.0), np.abs(off_tm).max(initial=0.0))
            < accuracy
        ):
            return level, te, tm
        te_block = enlarge_trial_space(trial.te, trial.te_sign, low_te, off_te, 1.0)
        tm_block = enlarge_trial_space(trial.tm, trial.tm_sign, low_tm, off_tm, -1.0)
        trial = RitzVectors(te_block[0], tm_block[0], te_block[1], tm_block[1])
        if len(trial.te_sign) + len(trial.tm_sign) > 0.8 * (
            len(pencil.te) + len(pencil.tm)
        ):
            return None
    return None


def matrix_root(
    square: np.ndarray, signs: np.ndarray, least: float, accuracy: float
) -> np.ndarray | None:
    """Matrix square root X with eigenvalues in the right half plane, near the root of its
    diagonal; None if it is not.

    In single precision as far as that goes, half the time of double.

    Args:
        square: X^2. signs: of growth, with respect to which it is symmetric.
        least: levels of the diagonal below it are lifted to it.
        accuracy: relative, of the result.
    """
    n = len(square)
    diagonal = np.sqrt(np.maximum(np.diag(square), least))
    order = np.argsort(diagonal)
    diagonal, ordered = diagonal[order], signs[order]
    weight = 1 / (diagonal[:, None] + diagonal)
    rest = square.take(order, 0).take(order, 1) * weight
    rest.ravel()[:: n + 1] -= diagonal / 2
    aim = max(accuracy * diagonal[0], ROUNDING * diagonal[-1])
    rough = rest.astype(np.float32), weight.astype(np.float32)
    near = fixed_point(
        rough[0], rough, ordered, max(aim, ROUGH * diagonal[0]), whole=WHOLE
    )
    e = None if near is None else near.astype(float)
    if e is not None and accuracy < SINGLE:
        e = fixed_point(e, (rest, weight), ordered, aim, whole=1)
    if e is None:
        return None
    e.ravel()[:: n + 1] += diagonal
    back = np.argsort(order)
    return np.asarray(e.take(back, 0).take(back, 1))


def fixed_point(
    e: np.ndarray,
    fixed: tuple[np.ndarray, np.ndarray],
    signs: np.ndarray,
    aim: float,
    *,
    whole: int,
) -> np.ndarray | None:
    """Fixed point E = rest - weight E^2; None where the steps do not shrink.

    The rows of the lowest levels converge last: they are watched until they move by less
    than ``aim``, and after ``whole`` steps go on alone until all rows are worth another.

    Args:
        e: the start. fixed: (rest, weight). signs: of growth.
    """
    rest, weight = fixed
    slow = max(1, len(e) // SLOW)
    mirror = (signs[:slow] * signs[:, None]).astype(e.dtype)
    change, first, last = np.inf, np.inf, np.inf
    for step in range(STEPS):
        if step < whole or change < max(aim, SETTLED * last):
            after = symmetric_square(e, signs)
            after *= weight
            np.subtract(rest, after, out=after)
            last = change = float(np.abs(after[:slow] - e[:slow]).max())
            e = after
            if change < aim:
                return symmetrize_by_signs(e, signs)
        else:
            rows = e[:slow] @ e
            rows *= weight[:slow]
            np.subtract(rest[:slow], rows, out=rows)
            change = float(np.abs(rows - e[:slow]).max())
            e[:slow], e[:, :slow] = rows, mirror * rows.T
        first = change if step == 0 else first
        if not change <= 2 * first:
            return None
    return None


def symmetrize_by_signs(e: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """A matrix ``e`` made symmetric with respect to the ``signs`` to the last bit:
    products of some processors are not, and the rest is light that is lost.
    """
    mirror = (signs[:, None] * signs).astype(e.dtype) * e.T
    return np.asarray((e + mirror) / 2)


def symmetric_square(e: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """e @ e of a matrix that is symmetric with respect to the signs: strips of rows
    from the diagonal on, and their
    mirror images."""
    n, found = len(e), np.empty_like(e)
    for start in range(0, n, -(-n // STRIPS)):
        rows = slice(start, start - (-n // STRIPS))
        beyond = slice(start - (-n // STRIPS), n)
        found[rows, start:] = e[rows] @ e[:, start:]
        found[beyond, rows] = (signs[beyond, None] * signs[rows]).astype(
            e.dtype
        ) * found[rows, beyond].T
    return found


def few_modes(pencil: LayerPencil, height: float, *, weak: float) -> FewModes | None:
    """Modes of a layer that carry light over its height, and the admittance of the rest;
    None where they are not few.

    Args:
        pencil: of the layer. height: in half pitches.
        weak: the accuracy asked for, relative; weaker modes are left out.
    """
    found = carrying_modes(pencil, height, weak, 0.1 * math.sqrt(weak))
    if found is None:
        return None
    level, te, tm = found
    a = len(pencil.te)
    sign = np.concatenate([pencil.te_sign, pencil.tm_sign])
    field = np.concatenate([te, tm])
    partner = sign[:, None] * field
    square = np.zeros((len(sign), len(sign)))
    square.ravel()[:: len(sign) + 1] = np.concatenate([pencil.te, pencil.tm])
    square[:a, a:] = pencil.te_sign[:, None] * pencil.coupling
    square[a:, :a] = pencil.tm_sign[:, None] * pencil.coupling.T
    if pencil.te_rest is not None:
        square[:a, :a] += pencil.te_rest
    if pencil.tm_rest is not None:
        square[a:, a:] += pencil.tm_rest
    common = max(float(np.abs(level).max(initial=0.0)), 1.0)
    norm = np.einsum("ij,ij->j", partner, field)
    square += ((field * ((common - level) / norm)) @ partner.T).real
    near = matrix_root(square, sign, common, weak)
    if near is None:
        return None
    return FewModes(
        axial_wavenumber(-level),
        field,
        partner,
        -sign[:, None] * near,
        -np.sqrt(common),
    )
