"""What the frames can tell and what they cannot: identifiable combinations,
degeneracies in words, densities.
"""

import numpy as np

from characterize.model import PARAMETERS, PLACE, typical_scales
from metalens.core.arrays import Array


def correlated_pairs(
    names: tuple[str, ...], covariance: Array, sigma_prior: Array
) -> list[str]:
    """Pairs of parameters correlated beyond 0.9, and parameters of little information
    in the frames.

    Args:
        names: (p,) names of the fitted parameters.
        covariance: (p, p) of the parameters.
        sigma_prior: (p,) prior standard deviation of each, inf where none.
    """
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    words = []
    rows, columns = np.tril_indices(len(names), -1)
    for k in np.argsort(-np.abs(correlation[rows, columns])):
        i, j = int(rows[k]), int(columns[k])
        if abs(correlation[i, j]) > 0.9:
            methods = (PARAMETERS[PLACE[names[k]]].measured_by for k in (j, i))
            either = " or ".join(dict.fromkeys(filter(None, methods))) or "either"
            words.append(
                f"{names[j]} and {names[i]} go together (correlation {correlation[i, j]:+.3f}): "
                f"measure {either}, which settles both"
            )
    for name, s, prior in zip(names, sigma, sigma_prior, strict=True):
        if np.isfinite(prior) and s > 0.8 * prior:
            words.append(
                f"{name} comes from prior knowledge ({prior:g}), the frames add little (now {s:.3g})"
            )
    return words


def identifiable_combinations(
    names: tuple[str, ...], information: Array, sigma_prior: Array
) -> list[str]:
    """Combinations (in typical units) that the frames alone fix better than prior
    knowledge, best first, in words.

    Args:
        names: (p,) names of the fitted parameters.
        information: (p, p) Fisher information of the frames alone.
        sigma_prior: (p,) prior standard deviations, inf where none.
    """
    values, vectors = information_eigenvectors(names, information)
    unit = typical_scales(names)
    prior = np.minimum(sigma_prior / unit, 1e9)
    lines = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        sigma = max(value, 1e-30) ** -0.5
        if sigma < 0.5 * np.linalg.norm(prior * vector):
            main = [i for i in np.argsort(-np.abs(vector))[:3] if abs(vector[i]) > 0.15]
            parts = " ".join(f"{vector[i]:+.2f} {names[i]}/{unit[i]:g}" for i in main)
            lines.append(f"{parts} to {sigma:.2g}")
    return lines


def information_eigenvectors(
    names: tuple[str, ...], information: Array
) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors of the information in units of each parameter's
    typical scale.

    Args:
        names: (p,) names of the fitted parameters.
    """
    unit = typical_scales(names)
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    return np.maximum(values, 0), vectors


def profile_density(curve: Array, at: Array) -> Array:
    """(*shape) probability density of a parameter from its profile likelihood.

    exp(-rise / 2), normalised. The signed root of the rise, straight for a parabola, is
    interpolated linearly between the points and extrapolated.

    Args:
        curve: (2, points) values and rise of -2 ln L.
        at: (*shape) values of the parameter.
    """
    value, keep = np.unique(curve[0], return_index=True)
    root = np.sqrt(np.maximum(curve[1][keep], 0.0))
    root = np.where(np.arange(len(value)) < int(np.argmin(root)), -root, root)
    first = (root[1] - root[0]) / (value[1] - value[0])
    last = (root[-1] - root[-2]) / (value[-1] - value[-2])
    at_root = np.interp(at, value, root)
    at_root = np.where(at < value[0], root[0] + first * (at - value[0]), at_root)
    at_root = np.where(at > value[-1], root[-1] + last * (at - value[-1]), at_root)
    fine = np.linspace(value[0], value[-1], 2001)
    whole = np.trapezoid(np.exp(-(np.interp(fine, value, root) ** 2) / 2), fine)
    return np.asarray(np.exp(-(at_root**2) / 2) / whole)
