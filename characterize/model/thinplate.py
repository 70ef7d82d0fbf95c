"""Smooth phases over the aperture without a formula: thin-plate modes of what the
parameters cannot do.
"""

import functools
from collections.abc import Callable

import numpy as np
from scipy.interpolate import BSpline

from metalens.core.arrays import Array
from metalens.fabrication import WavefrontError, derivative_maps

MODES, KNOTS, EXPECTED_RAD = 24, 9, 0.3
_GRID = 61


def thin_plate_basis(u: Array, v: Array, count: int = MODES) -> Array:
    """(count, *shape) modes at lens places over the radius, of unit rms on the disc.

    Args:
        u: x on the lens over its radius.
        v: y on the lens over its radius.
    """
    weights, taken, _ = _modes()
    return np.asarray(
        np.tensordot(weights[:count], _splines(u, v), 1)
        - np.tensordot(taken[:count], _known(u, v), 1)
    )


def prior_rad() -> Array:
    """(modes,) prior standard deviation of every mode, rad.

    EXPECTED_RAD for the smoothest, then falling as its bending energy to the -1/2.
    """
    energy = _modes()[2]
    return np.asarray(EXPECTED_RAD * np.sqrt(energy[0] / energy))


def _splines(u: Array, v: Array) -> Array:
    """(KNOTS², *shape) bicubic B-splines on -1 to 1 along both axes, held at the rim
    outside.
    """
    knots = np.concatenate([[-1.0] * 3, np.linspace(-1, 1, KNOTS - 2), [1.0] * 3])

    def along(t: Array) -> Array:
        inside = np.clip(t.ravel(), -1, 1)
        return np.asarray(
            BSpline.design_matrix(inside, knots, 3).toarray().T.reshape(KNOTS, *t.shape)
        )

    return np.asarray(
        np.einsum("i...,j...->ij...", along(v), along(u)).reshape(KNOTS**2, *u.shape)
    )


def _known(u: Array, v: Array) -> Array:
    """(4 + wave-front causes, *shape) shapes that parameters already describe.

    Piston, tilts, defocus, and aberrations.
    """
    return np.concatenate(
        [
            np.stack([np.ones_like(u), u, v, u * u + v * v]),
            derivative_maps(WavefrontError, u, v),
        ]
    )


@functools.lru_cache
def _modes() -> tuple[Array, Array, Array]:
    """Smooth modes of least bending energy at unit rms, orthogonal to described shapes.

    Splines less their least-squares fit by the shapes of :func:`_known`, on a grid.

    Returns:
        ((MODES, splines) weights, (MODES, shapes) weights, (MODES,) energy): a mode is
        the first @ splines - the second @ shapes.
    """
    t = np.linspace(-1, 1, _GRID)
    u, v = np.meshgrid(t, t)
    inside = np.hypot(u, v) <= 1
    splines = _splines(u, v).reshape(KNOTS**2, -1)
    described = _known(u, v).reshape(-1, _GRID**2)
    disc = inside.ravel()
    taken = np.linalg.lstsq(described[:, disc].T, splines[:, disc].T, rcond=None)[0].T
    remainder = (splines - taken @ described).reshape(-1, _GRID, _GRID)
    mass = remainder[:, inside] @ remainder[:, inside].T / inside.sum()
    size, vectors = np.linalg.eigh(mass)
    # generalised eigenvectors: least bending energy over mean square
    span = size > 1e-5 * size[-1]
    unit = vectors[:, span] / np.sqrt(size[span])
    bend = _bending(remainder, inside, t[1] - t[0])
    energy, turn = np.linalg.eigh(unit.T @ bend @ unit)
    weights = (unit @ turn[:, :MODES]).T
    return weights, weights @ taken, energy[:MODES]


def _bending(shapes: Array, inside: Array, step: float) -> Array:
    """(k, k) mean of f_uu g_uu + 2 f_uv g_uv + f_vv g_vv over the disc, by differences."""
    gradient: Callable[..., list[Array]] = np.gradient
    by_v, by_u = gradient(shapes, step, axis=(1, 2))
    parts = [*gradient(by_u, step, axis=(1, 2)), gradient(by_v, step, axis=(1, 2))[0]]
    sums = [part[:, inside] @ part[:, inside].T for part in parts]
    return np.asarray((2 * sums[0] + sums[1] + sums[2]) / inside.sum())
