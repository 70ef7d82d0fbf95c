"""Plane waves through films, both polarisations, in float64: judges rays through films, shares no code with them.

A lens is point sources on a lattice. Their plane waves (a transform) gain the phase of every medium and the Fresnel
coefficients of every face, for s and p apart; the inverse transform is the field on the sensor.
"""

import itertools

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


def point_wave(films, order, *, wavelength, reach, turn=0.12, panels=1500):
    """Field at distances ``reach`` (n,) from the foot of a point of light of unit area, every face's mean of s and p.

    k²/2π times the integral of √T exp(ik sum t √(n² - p²)) J0(k p ρ) p over p, on a line ``turn`` rad below
    the axis, where waves fade that do not run: Gauss-Legendre over panels, 1e-12; less where waves gain much on that
    line, steep and far. films: (index, thickness); order: indices.
    """
    from scipy.special import jv

    k, end = 2 * np.pi / wavelength, 2.5 * min(n for n, _ in films)
    node, share = np.polynomial.legendre.leggauss(16)
    width = end / panels
    p = ((np.arange(panels)[:, None] + (node + 1) / 2) * width).ravel() * np.exp(-1j * turn)
    weight = np.tile(share * width / 2, panels) * np.exp(-1j * turn)
    both = np.ones((2, len(p)), complex)
    for a, b in itertools.pairwise(order):
        ca, cb = np.sqrt(1 - p * p / a**2), np.sqrt(1 - p * p / b**2)
        root = 2 * np.sqrt(a * ca * b * cb)
        both *= np.array([root / (a * ca + b * cb), root / (b * ca + a * cb)])
    level = np.sqrt((both**2).mean(0))
    wave = weight * p * level * np.exp(1j * k * sum(t * np.sqrt(n * n - p * p) for n, t in films))
    return np.array([k * k / (2 * np.pi) * (wave * jv(0, k * p * r)).sum() for r in reach])
