"""Plain sums and closed forms that judge the golden chain; no import of the toolchain.

Micrometres, radians, time factor exp(-iwt). Arrays are (y, x).
"""

import itertools

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import j0


def sommerfeld_kernel(films, wavelength_um, radii_um, count=1500):
    """Impulse response of plane-parallel media: Hankel transform of the plane waves.

    h(rho) = 1 / 2 pi * integral of exp(i sum kz t) J0(q rho) q dq over propagating q
    (Goodman, Fourier Optics, eq. 3-74, as a radial integral). Evanescent waves fade
    by exp(-k t); 1500 Gauss nodes integrate 800 rad of phase to rounding.

    Args:
        films: (index, thickness in um) from the pillars to the sensor.
        radii_um: (n,) lateral distances.

    Returns:
        (n,) complex, 1/um2, phase relative to the path along the axis.
    """
    k = 2 * np.pi / wavelength_um
    least = min(n for n, _ in films)
    node, weight = np.polynomial.legendre.leggauss(count)
    theta, weight = (node + 1) * np.pi / 4, weight * np.pi / 4
    q = k * least * np.sin(theta)
    dq = k * least * np.cos(theta) * weight
    path = sum(t * (np.sqrt((k * n) ** 2 - q**2) - k * n) for n, t in films)
    wave = np.exp(1j * path) * q * dq / (2 * np.pi)
    return np.array([wave @ j0(q * rho) for rho in np.asarray(radii_um)])


def kernel_table(films, wavelength_um, reach_um, step_um=0.05):
    """The same as a function of the lateral distance, through a cubic spline (1e-6)."""
    radii = np.arange(0, reach_um + 2 * step_um, step_um)
    return CubicSpline(radii, sommerfeld_kernel(films, wavelength_um, radii))


def ray_path(films, reach_um):
    """Optical path against lateral distance by Snell's law, less that along the axis.

    Args:
        films: (index, thickness in um) of plane-parallel media.
        reach_um: largest lateral distance.

    Returns:
        Spline of the optical path in um.
    """
    least = min(n for n, _ in films)
    straight = reach_um / sum(t for n, t in films if n == least)
    p = np.linspace(0, least * straight / np.hypot(1, straight), 8001)
    reach = sum(t * p / np.sqrt(n * n - p * p) for n, t in films)
    path = sum(t * n * n / np.sqrt(n * n - p * p) - n * t for n, t in films)
    return CubicSpline(reach, path)


def source_wave(x_um, y_um, films, tangents, wavelength_um):
    """Phase factor of a point source at the pillars; 1 at the middle of the lens.

    Args:
        films: (index, thickness) from the source, air first.
        tangents: (x, y) slopes of the chief ray in air; light of a positive slope moves
            to +x, its source lies at -x.
    """
    slope = np.hypot(*tangents)
    sine = slope / np.hypot(1, slope)
    aside = sum(t * sine / np.sqrt(n * n - sine**2) for n, t in films)
    toward = -aside * np.asarray(tangents) / slope if slope else np.zeros(2)
    rho = np.hypot(x_um - toward[0], y_um - toward[1])
    path = ray_path(films, 1.05 * rho.max() + 1.0)
    return np.exp(2j * np.pi / wavelength_um * (path(rho) - path(np.hypot(*toward))))


def fields(x_um, y_um, lights, kernel, area_um2, u_um, v_um):
    """(n, v, u) fields on the sensor: the sum over all pillars, point by point.

    Args:
        x_um, y_um: (m,) places of the pillars. lights: (m, n) amplitudes behind them.
        kernel: of :func:`kernel_table`. area_um2: of one site.
    """
    rows = []
    for v in v_um:
        rho = np.hypot(np.asarray(u_um)[:, None] - x_um, v - y_um)
        rows.append(kernel(rho) @ lights)
    return np.moveaxis(np.array(rows), -1, 0) * area_um2


def pixel_nodes(count, pixel_um, centre_um, points=3):
    """Gauss-Legendre nodes of a row of pixels about a centre, and their weights in um."""
    node, weight = np.polynomial.legendre.leggauss(points)
    middle = (np.arange(count) - (count - 1) / 2) * pixel_um + centre_um
    return (middle[:, None] + node * pixel_um / 2).ravel(), weight * pixel_um / 2


def on_pixels(intensity, weight):
    """(..., y, x) integrals over pixels of samples at :func:`pixel_nodes`."""
    points = len(weight)
    *lead, height, _ = intensity.shape
    blocks = intensity.reshape(*lead, height // points, points, -1, points)
    return np.einsum("...aibj,i,j->...ab", blocks, weight, weight)


def moments(intensity, x_um, y_um):
    """Centroid (x, y), variances (x, y) and covariance of a picture, um and um2."""
    share = intensity / intensity.sum()
    cx, cy = (share.sum(0) * x_um).sum(), (share.sum(1) * y_um).sum()
    dx, dy = x_um - cx, y_um - cy
    xx, yy = (share.sum(0) * dx**2).sum(), (share.sum(1) * dy**2).sum()
    return np.array([cx, cy, xx, yy, dy @ share @ dx])


def normal_transmission(media):
    """Power through the faces between media at normal incidence (Fresnel)."""
    return np.prod([4 * a * b / (a + b) ** 2 for a, b in itertools.pairwise(media)])


def drawn_diameter_nm(made_nm, table_nm):
    """Diameter to draw so that drawn + bias(drawn) is made; bias linear in a table."""
    drawn = np.arange(40.0, 400.0, 0.01)
    places, bias = np.array(table_nm).T
    return np.interp(made_nm, drawn + np.interp(drawn, places, bias), drawn)


def fisher_sigma(predict, place, steps, variance):
    """Cramer-Rao standard deviations of parameters of pictures with Gaussian noise.

    Args:
        predict: parameters (p,) to expected values of any shape.
        place: (p,) where; steps: (p,) for central differences.
        variance: of every value.
    """
    slopes = []
    for k, step in enumerate(steps):
        move = np.zeros(len(place))
        move[k] = step
        slopes.append((predict(place + move) - predict(place - move)) / (2 * step))
    slopes = np.array([s.ravel() / np.sqrt(variance.ravel()) for s in slopes])
    return np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T)))
