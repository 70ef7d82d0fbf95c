"""Modes of the patterned layer, in the basis of the homogeneous modes: all of them, or
the few that carry light over it.
"""

import math
import sys
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from metalens.modal.case import ModalCase
from metalens.modal.spaces import HomogeneousBasis


@dataclass(frozen=True, eq=False, slots=True)
class LayerModes:
    """Modes that carry light over a layer, and the admittance of the layer without end.

    q: (c,) axial wavenumbers, decaying or going up. field, partner: (n, c) in the
        coordinates of the layer, partner = growth field.
    near: (n, n) admittance, with ``near_rate`` (c,) in place of i q for the modes that
        carry; real where the layer is lossless.
    turn: (n, n) fields of the coordinates in the homogeneous basis, block-diagonal
        from ``te_count`` on. dual: whether the unknown is the partner.
    """

    q: np.ndarray
    field: np.ndarray
    partner: np.ndarray
    near: np.ndarray
    near_rate: np.ndarray
    turn: np.ndarray
    te_count: int
    dual: bool

    def congruence(self, diagonal: np.ndarray) -> np.ndarray:
        """turnᵀ diagonal turn (n, n) of a ``diagonal`` (n,)."""
        a = self.te_count
        blocks = (slice(a), slice(a, None))
        turns = [(self.turn[block, block], diagonal[block]) for block in blocks]
        parts = [turn.T @ (d[:, None] * turn) for turn, d in turns]
        return np.asarray(sl.block_diag(*parts))


def axial_wavenumber(square: np.ndarray) -> np.ndarray:
    """Square root q of q^2 (``square``) that decays upwards, or goes up where it does
    neither.
    """
    q = np.sqrt(square + 0j)
    flip = (q.imag < 0) | ((np.abs(q.imag) <= 1e-9 * np.abs(q)) & (q.real < 0))
    return np.where(flip, -q, q)


def layer_modes(
    basis: HomogeneousBasis, case: ModalCase, *, magnetic: bool
) -> LayerModes:
    """All layer modes, stiffness w = -q^2 growth w, by a dense eigensolver; they are
    the coordinates.

    Electric form, u = E_t: growth = diag(1, (1 - scalar_eps^-1 tm / k0^2)^-1), stiffness
    = curl - k0^2 mass_eps. Magnetic form, u = H_t: growth = (mass_(1/eps)^-1 - diag(0,
    tm / k0^2))^-1, stiffness = curl_(1/eps) - k0^2. TM fields are scaled by k0 /
    sqrt(tm).

    Args:
        basis: homogeneous modes. case: wavenumber, height and permittivities.
        magnetic: the form.
    """
    disc, around = case.disc, case.around
    if disc.imag == around.imag == 0:  # the arithmetic stays real
        disc, around = disc.real, around.real
    n, a, k2 = basis.size, len(basis.te), case.k0**2
    scale = case.k0 / np.sqrt(basis.tm)
    scaling = np.concatenate([np.ones(a), scale])
    tm = np.arange(a, n)
    if magnetic:
        disc, around = 1 / disc, 1 / around
        inverse = np.linalg.inv((disc - around) * basis.disc_mass + around * np.eye(n))
        inverse = scaling[:, None] * inverse * scaling
        inverse[tm, tm] -= 1
        growth = np.linalg.inv(inverse)
        stiffness = np.diag(np.concatenate([around * basis.te - k2, -basis.tm]))
        stiffness[:a, :a] += (disc - around) * basis.disc_curl
    else:
        scalar = (disc - around) * basis.disc_scalar + around * np.eye(n - a)
        growth = np.eye(n, dtype=scalar.dtype)
        growth[a:, a:] = -np.linalg.solve(np.eye(n - a) - scalar * scale**2, scalar)
        mass = (disc - around) * basis.disc_mass + around * np.eye(n)
        stiffness = -k2 * mass / scaling[:, None] / scaling
        stiffness[:a, :a] += np.diag(basis.te)
    growth = (growth + growth.T) / 2
    level = 1 / np.sqrt(np.concatenate([basis.te + k2, basis.tm]))
    balanced = level[:, None] * stiffness * level
    value, vectors = np.linalg.eig(
        level[:, None] * np.linalg.solve(balanced, level[:, None] * growth)
    )
    q = axial_wavenumber(-1 / value)
    fade = np.abs(np.exp(1j * q * case.height))
    carry = np.flatnonzero(fade > sys.float_info.epsilon)
    norm = vectors.T @ growth @ vectors
    return LayerModes(
        q[carry],
        np.eye(n)[:, carry],
        norm[:, carry],
        1j * q * norm,
        1j * q[carry],
        vectors / scaling[:, None],
        n,
        dual=False,
    )


# --- the modes that carry light over a layer, and all others in one matrix root

# accuracy of a root in single precision, whose errors matter ten times less, and in
# double
ROUGH, ROUNDING = 3e-7, 1e-14


@dataclass(frozen=True, eq=False, slots=True)
class LayerPencil:
    """Equation square y = -q^2 y of a lossless layer, real, with nearly diagonal TE and
    TM blocks.

    square: (n, n) growth⁻¹ stiffness, symmetric but for the rows' ``sign`` (n,), that
        of growth. turn: (n, n) block-diagonal, fields of y in the homogeneous basis.
    te_count: size of the TE block. dual: whether the unknown is the partner.
    """

    square: np.ndarray
    sign: np.ndarray
    turn: np.ndarray
    te_count: int
    dual: bool


def is_lossless(case: ModalCase) -> bool:
    """Whether the layer of a ``case`` has positive real permittivities, as the definite
    blocks need.
    """
    return all(e.imag == 0 and e.real > 0 for e in (case.disc, case.around))


def diagonalize_low(
    block: np.ndarray, contrast: float, low: float = 32.0
) -> tuple[np.ndarray, np.ndarray]:
    """A symmetric matrix with its low levels diagonalised, and the turn (n, n).

    Args:
        block: (n, n), a rising diagonal plus a perturbation.
        contrast: size of the perturbation.
        low: levels above this, times the contrast, hardly change and are left.
    """
    m = max(1, int(np.searchsorted(block.diagonal(), low * contrast)))
    turn = np.eye(len(block))
    turn[:m, :m] = modes = np.linalg.eigh(block[:m, :m], UPLO="U")[1]
    block[:m] = modes.T @ block[:m]
    block[:, :m] = block[:, :m] @ modes
    return block, turn


def layer_pencil(
    basis: HomogeneousBasis, case: ModalCase, *, magnetic: bool
) -> LayerPencil:
    """Block-diagonalised equation of the layer.

    Electric form, u = E_t: growth = diag(1, (scalar_eps^-1 tm / k0^2 - 1)^-1 negative),
    stiffness = curl - k0^2 mass_eps. Magnetic form, for the dual unknown of u = H_t:
    growth = stiffness^-1, stiffness = mass_(1/eps)^-1 - diag(0, tm / k0^2).

    Args:
        basis: homogeneous modes. case: wavenumber and permittivities, lossless.
        magnetic: the form.
    """
    a, k2 = len(basis.te), case.k0**2
    disc, around = case.disc.real, case.around.real
    if magnetic:
        disc, around = 1 / disc, 1 / around
    contrast = disc - around
    mass = contrast * basis.disc_mass + around * np.eye(basis.size)
    if magnetic:
        weighted = np.linalg.inv(mass)
        curl = contrast * basis.disc_curl + np.diag(around * basis.te - k2)
        te, te_turn = sl.eigh(curl, weighted[:a, :a], type=2, lower=False)
        te_block, te_turn = np.diag(te), te_turn * np.sqrt(np.abs(te))
        tm_block = np.diag(basis.tm) - k2 * weighted[a:, a:]
        tm_block, tm_turn = diagonalize_low(tm_block, k2 * abs(contrast))
        tm_turn = tm_turn * case.k0
        te_sign, tm_sign = np.sign(te), -np.ones(len(basis.tm))
        cross = weighted[:a, a:]
    else:
        te_block = np.diag(basis.te) - k2 * mass[:a, :a]
        te_block, te_turn = diagonalize_low(te_block, k2 * abs(contrast))
        scalar = contrast * basis.disc_scalar + around * np.eye(len(basis.tm))
        root = np.sqrt(basis.tm / k2)
        inner = root[:, None] * np.linalg.inv(scalar) * root - np.eye(len(root))
        tm, tm_turn = sl.eigh(inner, k2 * mass[a:, a:], type=2, lower=False)
        tm_block, tm_turn = np.diag(tm), tm_turn * np.sqrt(np.abs(tm))
        te_sign, tm_sign = np.ones(a), -np.sign(tm)
        cross = -k2 * mass[:a, a:]
    coupling = te_turn.T @ cross @ tm_turn
    sign = np.concatenate([te_sign, tm_sign])
    upper, lower = te_sign[:, None] * coupling, tm_sign[:, None] * coupling.T
    square = np.block([[te_block, upper], [lower, tm_block]])
    return LayerPencil(square, sign, sl.block_diag(te_turn, tm_turn), a, dual=magnetic)


def carrying_modes(
    pencil: LayerPencil,
    height: float,
    weak: float,
    accuracy: float,
    spare: tuple[float, float] = (3.0, 60.0),
) -> tuple[np.ndarray, np.ndarray] | None:
    """-q^2 (c,) and vectors (n, c) of the modes that carry light, by Davidson's method.

    Each round solves the Rayleigh-Ritz problem on a trial space of pure TE and TM
    vectors, at first those of the low levels. The residuals of the high levels, divided
    by (level - value), enlarge it until they are negligible.

    Args:
        pencil: of the layer, of this ``height``. weak: as in :func:`few_modes`.
        accuracy: of the vectors, relative.
        spare: factor on the level of the weakest mode, and what is added, up to which
            levels are tried first; it decides the number of rounds alone.

    Returns:
        None if the modes are too many.
    """
    square, sign, a = pencil.square, pencil.sign, pencil.te_count
    level, n = square.diagonal(), len(sign)
    factor, further = spare
    low = level < factor * (math.log(weak) / height) ** 2 + further
    trial = np.eye(n)[:, low]
    te_high, tm_high = (~low & (np.arange(n) < a)), (~low & (np.arange(n) >= a))
    if (sign[te_high] < 0).any() or (sign[tm_high] > 0).any():
        return None
    while trial.shape[1] <= 0.6 * n:
        image = square @ trial
        growth = np.sign(sign @ trial**2)
        small = growth[:, None] * (trial.T @ (sign[:, None] * image))
        value, y = np.linalg.eig(small)
        fade = np.abs(np.exp(1j * axial_wavenumber(-value) * height))
        value, y = value[fade > weak], y[:, fade > weak]
        change = image @ y - (trial @ y) * value
        change[low] = 0.0
        change[~low] /= level[~low, None] - value
        if np.abs(change).max(initial=0.0) < accuracy:
            return value, trial @ y
        parts = [change.real, change.imag] if np.iscomplexobj(change) else [change]
        for block in (te_high, tm_high):
            added = np.concatenate(parts, 1) * block[:, None]
            added -= trial @ (trial.T @ added)
            left, size, _ = np.linalg.svd(added, full_matrices=False)
            trial = np.concatenate([trial, left[:, size > 1e-3 * size.max()]], 1)
    return None


def matrix_root(
    square: np.ndarray,
    sign: np.ndarray,
    least: float,
    accuracy: float,
    most_steps: int = 80,
) -> np.ndarray | None:
    """Matrix square root X with eigenvalues in the right half plane; None if the
    iteration does not converge.

    X = D + E, D the root of the diagonal. (D_i + D_j) E_ij + (E²)_ij = (X² - D²)_ij is
    solved by a fixed point, in single precision and, if that is not enough, double.

    Args:
        square: X². sign: of growth, with respect to which it is symmetric.
        least: levels of the diagonal below it are raised to it.
        accuracy: relative, of the result.
        most_steps: of the fixed point in either precision.
    """
    root = np.sqrt(np.maximum(square.diagonal(), least))
    mirror = sign[:, None] * sign
    exact_weight = 1 / (root[:, None] + root)
    exact_offset = square * exact_weight
    np.fill_diagonal(exact_offset, exact_offset.diagonal() - root / 2)
    limit = max(accuracy * root.min(), ROUNDING * root.max())
    correction = exact_offset
    for kind, aim in (
        (np.float32, max(limit, ROUGH * root.min())),
        (np.float64, limit),
    ):
        if kind is np.float64 and accuracy > ROUGH / 10:
            break
        weight, offset = exact_weight.astype(kind), exact_offset.astype(kind)
        e = correction.astype(kind)
        change = first = math.inf
        for _ in range(most_steps):
            moved = offset - weight * (e @ e)
            change = float(np.abs(moved - e).max())
            first, e = min(first, change), moved
            if change < aim or not change <= 2 * first:
                break
        if not change < aim:
            return None
        # an asymmetry of rounding would lose energy
        correction = ((e + mirror * e.T) / 2).astype(float)
    return np.asarray(correction + np.diag(root))


def few_modes(pencil: LayerPencil, height: float, *, weak: float) -> LayerModes | None:
    """Modes of a layer that carry light over its height, and the admittance of the
    rest; None where they are not few.

    Args:
        pencil: of the layer. height: in half pitches.
        weak: relative accuracy; modes weaker than this are left out.
    """
    carrying = carrying_modes(pencil, height, weak, 0.1 * math.sqrt(weak))
    if carrying is None:
        return None
    value, field = carrying
    partner = pencil.sign[:, None] * field
    common = max(float(np.abs(value).max(initial=0.0)), 1.0)
    norm = np.einsum("ij,ij->j", partner, field)
    others = pencil.square + ((field * ((common - value) / norm)) @ partner.T).real
    root = matrix_root(others, pencil.sign, common, weak)
    if root is None:
        return None
    return LayerModes(
        axial_wavenumber(-value),
        field,
        partner,
        -pencil.sign[:, None] * root,
        np.full(len(value), -math.sqrt(common)),
        pencil.turn,
        pencil.te_count,
        pencil.dual,
    )
