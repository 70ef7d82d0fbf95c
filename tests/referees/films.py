"""Plane waves through films, both polarisations, in float64: judges rays through films, shares no code with them.

A lens is point sources on a lattice. Their plane waves (a transform) gain the phase of every medium and the Fresnel
coefficients of every face, for s and p apart; the inverse transform is the field on the sensor.
"""

import numpy as np


class Stack:
    """films: (index, thickness) from pillars to sensor, the first fills the gap; lattice of ``count`` points."""

    def __init__(self, films, *, wavelength, step, count):
        self.films, self.k, self.step, self.count = films, 2 * np.pi / wavelength, step, count
        f = np.fft.fftfreq(count, step) * wavelength
        self.px, self.py = np.meshgrid(f, f)
        self.p2 = self.px**2 + self.py**2

    def transfer(self):
        """(2, y, x) of s and p light: amplitude of each plane wave, its square power along z; 0 where none runs."""
        low = min(n for n, _ in self.films)
        runs = self.p2 < (low * 0.999) ** 2
        p2 = np.where(runs, self.p2, 0)
        phase = sum(t * np.sqrt(n * n - p2) for n, t in self.films)
        both = np.ones((2, *p2.shape))
        for (a, _), (b, _) in zip(self.films[:-1], self.films[1:], strict=True):
            ca, cb = np.sqrt(1 - p2 / a**2), np.sqrt(1 - p2 / b**2)
            share = b * cb / (a * ca)
            both[0] *= 2 * a * ca / (a * ca + b * cb) * np.sqrt(share)
            both[1] *= 2 * a * ca / (b * ca + a * cb) * np.sqrt(share)
        return both * np.exp(1j * self.k * phase) * runs

    def fields(self, light, at=(0.0, 0.0)):
        """(2, y, x) fields of s and p light on the lattice about ``at``; light: (rows, columns) of the pillars."""
        grid = np.zeros((self.count, self.count), complex)
        rows, columns = light.shape
        grid[:rows, :columns] = light
        # the middle of the lens and of the lattice of the sensor at the origin
        shift_x = at[0] - (self.count - 1) / 2 * self.step + (columns - 1) / 2 * self.step
        shift_y = at[1] - (self.count - 1) / 2 * self.step + (rows - 1) / 2 * self.step
        move = np.exp(1j * self.k * (self.px * shift_x + self.py * shift_y))
        return np.fft.ifft2(np.fft.fft2(grid) * self.transfer() * move)


def source_phase(films, depth, beside, radii, wavelength, count=60000):
    """Phase (unwrapped about that at ``beside``) of a point source behind films at distances ``radii`` from its foot.

    films: (index, thickness), the medium of the source first, ``depth`` in all. Sum of plane waves: the integral over
    p of p J0(k p rho) exp(ik sum t sqrt(n² - p²)) / sqrt(n0² - p²), with a smooth end well beyond the rays in question.
    """
    from scipy.special import j0

    k, end = 2 * np.pi / wavelength, 0.75
    p = (np.arange(count) + 0.5) / count * end
    fade = np.clip((end - p) / (0.35 * end), 0, 1)
    fade = fade**3 * (10 - 15 * fade + 6 * fade**2)
    gap = depth - sum(t for _, t in films[1:])
    path = gap * (np.sqrt(films[0][0] ** 2 - p**2) - films[0][0])
    path = path + sum(t * (np.sqrt(n * n - p**2) - n) for n, t in films[1:])
    wave = p * fade * np.exp(1j * k * path) / np.sqrt(films[0][0] ** 2 - p**2)
    field = np.array([(wave * j0(k * p * r)).sum() for r in [beside, *radii]])
    return np.angle(field[1:] / field[0])
