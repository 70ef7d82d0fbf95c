"""Both polarisations of a lens in float64, plane wave by plane wave: judges the vector
PSF, shares no code with it.

The transverse field behind the lens on a fine lattice; its plane waves are transverse,
so that Ez = -(p Ex + q Ey)/s of
each; their sum on the sensor is |Ex|² + |Ey|² + |Ez|², the mean of both polarisations of the source.
"""

import numpy as np


def _lattice(step, wavelength, distance, count):
    """Direction cosines p, q, s of the plane waves of a lattice, and what each gains on
    the way; 0 where it fades.
    """
    f = np.fft.fftfreq(count, step) * wavelength
    p, q = np.meshgrid(f, f)
    runs = p**2 + q**2 < 0.998
    s = np.sqrt(np.where(runs, 1 - p**2 - q**2, 1))
    return p, q, s, runs * np.exp(2j * np.pi / wavelength * distance * s)


def _waves(field, cosines, move):
    """Plane waves Ex, Ey, Ez on the sensor of a field's x and y component."""
    p, q, s = cosines
    ex, ey = (
        np.fft.fft2(np.pad(e, [(0, len(p) - n) for n in e.shape])) * move for e in field
    )
    return ex, ey, -(p * ex + q * ey) / s


def image(light, *, step, wavelength, distance, count):
    """(count, count) intensity on the lattice of a field (2 polarisations, x and y
    component, rows, columns).
    """
    *cosines, move = _lattice(step, wavelength, distance, count)
    total = np.zeros((count, count))
    for field in light:
        total += (
            sum(np.abs(np.fft.ifft2(w)) ** 2 for w in _waves(field, cosines, move)) / 2
        )
    return total


def turned(x, y, distance):
    """(2, 2, …) transverse field of x and y light whose rays a lens turns from its axis
    to a point on it.

    Along the plane of the ray the field is turned with it, across it stays; its power
    along z is kept.
    """
    azimuth = np.arctan2(-y, -x)
    cosine = distance / np.sqrt(x**2 + y**2 + distance**2)
    c, s = np.cos(azimuth), np.sin(azimuth)
    along, across = np.sqrt(cosine), 1 / np.sqrt(cosine)
    mixed = (along - across) * s * c
    return np.array(
        [[along * c**2 + across * s**2, mixed], [mixed, along * s**2 + across * c**2]]
    )


def flux(light, *, step, wavelength, distance, count):
    """As :func:`image`: Re(Ex Hy* - Ey Hx*) of E and of H = b x E of every plane wave,
    the mean of both.
    """
    *cosines, move = _lattice(step, wavelength, distance, count)
    p, q, s = cosines
    total = np.zeros((count, count))
    for field in light:
        ex, ey, ez = _waves(field, cosines, move)
        ex, ey, hx, hy = (
            np.fft.ifft2(w) for w in (ex, ey, q * ez - s * ey, s * ex - p * ez)
        )
        total += np.real(ex * hy.conj() - ey * hx.conj()) / 2
    return total
