"""Modes of the patterned layer, in the basis of the homogeneous modes."""

from dataclasses import dataclass

import numpy as np

from metalens.modal.spaces import HomogeneousBasis


@dataclass(frozen=True, eq=False, slots=True)
class LayerMedium:
    """Numbers of one case in half pitches: k0 and the permittivities of disc and
    surroundings.
    """

    k0: float
    disc: complex
    around: complex

    def permittivities(self) -> tuple[complex, complex]:
        """Both, as real numbers where neither absorbs: the arithmetic stays real."""
        if self.disc.imag == 0 and self.around.imag == 0:
            return self.disc.real, self.around.real
        return self.disc, self.around


@dataclass(frozen=True, eq=False, slots=True)
class LayerModes:
    """Fields and partners of the layer modes, with one scale for each column of both.

    q: (n,) axial wavenumbers, decaying or going up. field: (n, n) w. partner: (n, n)
    growth w.
    """

    q: np.ndarray
    field: np.ndarray
    partner: np.ndarray


def axial_wavenumber(square: np.ndarray) -> np.ndarray:
    """Square root q of q^2 (``square``) that decays upwards, or goes up where it does
    neither.
    """
    q = np.sqrt(square + 0j)
    flip = (q.imag < 0) | ((np.abs(q.imag) <= 1e-9 * np.abs(q)) & (q.real < 0))
    return np.where(flip, -q, q)


def electric_modes(basis: HomogeneousBasis, medium: LayerMedium) -> LayerModes:
    """Layer modes for u = E_t by a dense eigensolver.

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities.
    """
    disc, around = medium.permittivities()
    n, te_count, k0 = basis.size, len(basis.te), medium.k0
    scale = k0 / np.sqrt(basis.tm)
    scaling = np.concatenate([np.ones(te_count), scale])
    stiffness = -(k0**2) * (disc - around) * basis.disc_mass
    diagonal = np.arange(n)
    stiffness[diagonal, diagonal] -= k0**2 * around
    stiffness[diagonal[:te_count], diagonal[:te_count]] += basis.te
    level = 1 / np.concatenate([np.sqrt(basis.te + k0**2), np.full(n - te_count, k0)])
    inverse = np.linalg.inv(level[:, None] * stiffness * level)
    longitudinal = (disc - around) * basis.disc_scalar + around * np.eye(n - te_count)
    tm_growth = np.linalg.solve(
        np.eye(n - te_count) - longitudinal * scale**2, longitudinal
    )
    tm_growth = (tm_growth + tm_growth.T) / 2
    level = level * scaling
    inverse_pencil = level[:, None] * inverse * level
    inverse_pencil[:, te_count:] = -inverse_pencil[:, te_count:] @ tm_growth
    value, vectors = np.linalg.eig(inverse_pencil)
    partner = vectors.copy()
    partner[te_count:] = -tm_growth @ vectors[te_count:]
    return LayerModes(
        axial_wavenumber(-1 / value),
        vectors / scaling[:, None],
        partner * scaling[:, None],
    )


def magnetic_modes(basis: HomogeneousBasis, medium: LayerMedium) -> LayerModes:
    """Layer modes for u = H_t by a dense eigensolver.

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities.
    """
    disc, around = (1 / e for e in medium.permittivities())
    n, te_count, k0 = basis.size, len(basis.te), medium.k0
    scale = k0 / np.sqrt(basis.tm)
    scaling = np.concatenate([np.ones(te_count), scale])
    weighted = (disc - around) * basis.disc_mass + around * np.eye(n)
    inverse = scaling[:, None] * np.linalg.inv(weighted) * scaling
    tm_places = np.arange(te_count, n)
    inverse[tm_places, tm_places] -= 1
    growth = np.linalg.inv(inverse)
    growth = (growth + growth.T) / 2
    stiffness = (disc - around) * basis.disc_curl + np.diag(around * basis.te - k0**2)
    level = 1 / np.sqrt(basis.te + k0**2)
    inverse_pencil = np.empty_like(growth)
    inverse_pencil[:te_count] = level[:, None] * np.linalg.solve(
        level[:, None] * stiffness * level, level[:, None] * growth[:te_count]
    )
    inverse_pencil[te_count:] = -((scale / k0) ** 2)[:, None] * growth[te_count:]
    value, vectors = np.linalg.eig(inverse_pencil)
    return LayerModes(
        axial_wavenumber(-1 / value),
        vectors / scaling[:, None],
        scaling[:, None] * (growth @ vectors),
    )
