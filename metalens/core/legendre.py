"""Orthonormal Legendre polynomials: nodes, interpolation, and how many are needed for a
given function.
"""

import functools

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.special import roots_legendre

from metalens.core.arrays import Array


@functools.lru_cache(maxsize=64)
def gauss_legendre_nodes(count: int) -> tuple[Array, Array]:
    """(count,) Gauss-Legendre nodes and weights on [-1, 1]; treat as read-only."""
    t, w = roots_legendre(count)
    return np.asarray(t), np.asarray(w)


def legendre_values(count: int, t: Array) -> Array:
    """(*t, count) orthonormal Legendre polynomials P̂_0 … P̂_{count-1} at t, with ∫P̂²
    = 1 on [-1, 1].

    Args:
        count: number of polynomials.
        t: places in [-1, 1], an array of any shape.
    """
    scale = np.sqrt(np.arange(count) + 0.5)
    t = np.asarray(t, float)  # legvander takes a number for an array of one
    values = legvander(t, count - 1).reshape(*t.shape, count)
    return np.asarray(values * scale)


def interpolation_matrix(count: int, t: Array) -> Array:
    """(*t, count) values at ``t`` of the Lagrange polynomials on
    :func:`gauss_legendre_nodes`: L_a(t) = w_a Σ_m P̂_m(t_a) P̂_m(t).

    Args:
        count: number of nodes.
        t: places in [-1, 1].
    """
    return np.asarray(legendre_values(count, t) @ to_nodes(count))


@functools.lru_cache(maxsize=64)
def to_nodes(count: int) -> Array:
    """(mode, node) matrix w_a P̂_m(t_a): maps values at the nodes to Legendre
    coefficients.

    Args:
        count: number of nodes and of modes.
    """
    t, w = gauss_legendre_nodes(count)
    return legendre_values(count, t).T * w


def mapped_nodes(count: int, low: float, high: float) -> Array:
    """(count,) Gauss-Legendre nodes on [low, high]."""
    return (low + high) / 2 + (high - low) / 2 * gauss_legendre_nodes(count)[0]


def needed_node_count(samples: Array, tolerance: float) -> int:
    """Number of Gauss-Legendre nodes that represent all lines to ``tolerance``.

    Args:
        samples: (line, count) complex values on :func:`gauss_legendre_nodes` (count),
            with count well above the result.
        tolerance: of the root mean square over lines and position, relative to that of
            the samples.

    Returns:
        The least n with a tail of modes n, n+1, … below tolerance; ``count`` + 1 where
            the samples are too few to tell.
    """
    count = samples.shape[-1]
    power = (np.abs(samples.reshape(-1, count) @ to_nodes(count).T) ** 2).sum(0)
    tail = np.sqrt(np.cumsum(power[::-1])[::-1] / power.sum())
    sufficient = np.nonzero(tail <= tolerance)[0]
    return (
        int(sufficient[0])
        if sufficient.size and sufficient[0] <= 0.85 * count
        else count + 1
    )
