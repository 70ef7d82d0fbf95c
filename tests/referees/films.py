"""Plane waves through films, both polarisations, in float64: judges rays through films,
shares no code with them.

A lens is point sources on a lattice. Their plane waves (a transform) gain the phase of
every medium and the Fresnel
coefficients of every face, for s and p apart; the inverse transform is the field on the
sensor.
"""

import itertools

import numpy as np


def rise(u):
    """From 0 to 1 over u of 0 to 1, with two derivatives that are 0 at either end."""
    return u**3 * (10 - 15 * u + 6 * u**2)


class Stack:
    """films: (index, thickness) from pillars to sensor, the first fills the gap;
    lattice of ``count`` points.

    near: um, where light of the lens can fall on what is looked at (radius and half
    window): plane waves that fall
    further aside are faded out, where they would come back over the lattice's edge.
    None: all are kept.
    """

    def __init__(self, films, *, wavelength, step, count, near=None):
        self.near = near
        self.films, self.k, self.step, self.count = (
            films,
            2 * np.pi / wavelength,
            step,
            count,
        )
        f = np.fft.fftfreq(count, step) * wavelength
        self.px, self.py = np.meshgrid(f, f)
        self.p2 = self.px**2 + self.py**2

    def transfer(self):
        """(2, y, x) of s and p light: amplitude of each plane wave, its square power
        along z; 0 where none runs.
        """
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
        return both * np.exp(1j * self.k * phase) * runs * self._lands(p2)

    def _lands(self, p2):
        """1 for plane waves whose rays fall near the axis, 0 for those that wrap."""
        if self.near is None:
            return 1.0
        beside = sum(t * np.sqrt(p2 / (n * n - p2)) for n, t in self.films)
        u = np.clip(
            (beside - self.near) / (self.count * self.step - 2 * self.near), 0, 1
        )
        return 1 - rise(u)

    def fields(self, light, at=(0.0, 0.0)):
        """(2, y, x) fields of s and p light on the lattice about ``at``; light: (rows,
        columns) of the pillars.
        """
        return np.fft.ifft2(self._waves(light, at) * self.transfer())

    def flux(self, light, at=(0.0, 0.0)):
        """(y, x) power through the sensor of light (2 polarisations, Ex and Ey at the
        pillars, rows, columns), mean of
        both: every plane wave parted into s and p, each with its own Fresnel
            coefficients; H = n b x E."""
        first, last = self.films[0][0], self.films[-1][0]
        runs = self.p2 < (0.999 * min(n for n, _ in self.films)) ** 2
        size = np.sqrt(np.where(runs, self.p2, 0))
        ux = np.where(size > 0, self.px / np.where(size > 0, size, 1), 1.0)
        uy = np.where(size > 0, self.py / np.where(size > 0, size, 1), 0.0)
        near = np.sqrt(1 - (size / first) ** 2)
        far = np.sqrt(1 - (size / last) ** 2)
        in_s, in_p = self.transfer() * np.sqrt(first * near / (last * far))
        total = 0.0
        for ex, ey in light:
            ex, ey = self._waves(ex, at), self._waves(ey, at)
            s = (ux * ey - uy * ex) * in_s
            p = (ux * ex + uy * ey) / near * in_p
            e = p * far * ux - s * uy, p * far * uy + s * ux
            h = last * (-s * far * ux - p * uy), last * (-s * far * uy + p * ux)
            e, h = (tuple(np.fft.ifft2(part) for part in both) for both in (e, h))
            total = total + (e[0] * h[1].conj() - e[1] * h[0].conj()).real / 2
        return total

    def _waves(self, light, at):
        """Plane waves of light (rows, columns) on the lattice, the middle of the lens
        at the origin and that of the
        lattice of the sensor at ``at``."""
        grid = np.zeros((self.count, self.count), complex)
        rows, columns = light.shape
        grid[:rows, :columns] = light
        shift_x = (
            at[0] - (self.count - 1) / 2 * self.step + (columns - 1) / 2 * self.step
        )
        shift_y = at[1] - (self.count - 1) / 2 * self.step + (rows - 1) / 2 * self.step
        return np.fft.fft2(grid) * np.exp(
            1j * self.k * (self.px * shift_x + self.py * shift_y)
        )


def source_phase(films, depth, beside, radii, wavelength, count=60000):
    """Phase (unwrapped about that at ``beside``) of a point source behind films at
    distances ``radii`` from its foot.

    films: (index, thickness), the medium of the source first, ``depth`` in all. Sum of
    plane waves: the integral over
    p of p J0(k p rho) exp(ik sum t sqrt(n² - p²)) / sqrt(n0² - p²), with a smooth end
    well beyond the rays in question.
    """
    from scipy.special import j0

    k, end = 2 * np.pi / wavelength, 0.75
    p = (np.arange(count) + 0.5) / count * end
    fade = np.clip((end - p) / (0.35 * end), 0, 1)
    fade = rise(fade)
    gap = depth - sum(t for _, t in films[1:])
    path = gap * (np.sqrt(films[0][0] ** 2 - p**2) - films[0][0])
    path = path + sum(t * (np.sqrt(n * n - p**2) - n) for n, t in films[1:])
    wave = p * fade * np.exp(1j * k * path) / np.sqrt(films[0][0] ** 2 - p**2)
    field = np.array([(wave * j0(k * p * r)).sum() for r in [beside, *radii]])
    return np.angle(field[1:] / field[0])


def point_wave(films, order, *, wavelength, reach, turn=0.12, panels=1500, apart=False):
    """Field at distances ``reach`` (n,) from the foot of a point of light of unit area,
    every face's mean of s and
    p; or (2, n) of s and of p apart.

    k²/2π times the integral of √T exp(ik sum t √(n² - p²)) J0(k p ρ) p over p, on a
    line ``turn`` rad below the axis,
    where waves fade that do not run: Gauss-Legendre over panels, 1e-12; less where
    waves gain much on that line, steep
    and far. films: (index, thickness); order: indices.
    """
    from scipy.special import jv

    k, end = 2 * np.pi / wavelength, 2.5 * min(n for n, _ in films)
    node, share = np.polynomial.legendre.leggauss(16)
    width = end / panels
    p = ((np.arange(panels)[:, None] + (node + 1) / 2) * width).ravel() * np.exp(
        -1j * turn
    )
    weight = np.tile(share * width / 2, panels) * np.exp(-1j * turn)
    both = np.ones((2, len(p)), complex)
    for a, b in itertools.pairwise(order):
        ca, cb = np.sqrt(1 - p * p / a**2), np.sqrt(1 - p * p / b**2)
        root = 2 * np.sqrt(a * ca * b * cb)
        both *= np.array([root / (a * ca + b * cb), root / (b * ca + a * cb)])
    level = both if apart else np.sqrt((both**2).mean(0))
    wave = (
        weight
        * p
        * level
        * np.exp(1j * k * sum(t * np.sqrt(n * n - p * p) for n, t in films))
    )
    return np.stack(
        [k * k / (2 * np.pi) * (wave * jv(0, k * p * r)).sum(-1) for r in reach], -1
    )


def sums(light, at, points, films, order, wavelength):
    """(2, n) fields of s and of p at points (n, 2) of light (m,) at pillars ``at`` (m,
    2), each the sum of its plane
    waves: :func:`point_wave` over exp(ik path) / path, a series in the cosine of the
    ray. Paths by bisection."""
    k, rare = 2 * np.pi / wavelength, min(n for n, _ in films)

    def lands(p):
        return sum(t * p / np.sqrt(n * n - p * p) for n, t in films)

    def plain(p):
        path = sum(n * n * t / np.sqrt(n * n - p * p) for n, t in films)
        return np.exp(1j * k * path) / path

    far = np.hypot(points[:, None, 0] - at[:, 0], points[:, None, 1] - at[:, 1])
    low = np.zeros(far.shape)
    high = np.full(far.shape, rare * (1 - 1e-9))
    for _ in range(60):
        p = (low + high) / 2
        less = lands(p) < far
        low, high = np.where(less, p, low), np.where(less, high, p)
    for _ in range(2):  # the last digits by Newton's rule
        p = p + (far - lands(p)) / sum(
            t * n * n / np.sqrt(n * n - p * p) ** 3 for n, t in films
        )
    ends = np.sqrt(rare**2 - p.max() ** 2), np.sqrt(rare**2 - p.min() ** 2)
    middle = (ends[0] + ends[1]) / 2
    half = (ends[1] - ends[0]) / 2 + 1e-9
    node = np.cos(np.pi * (np.arange(18) + 0.5) / 18)
    some = np.sqrt(rare**2 - (middle + half * node) ** 2)
    length = sum(t for _, t in films)
    waves = point_wave(
        films,
        order,
        wavelength=wavelength,
        reach=lands(some),
        apart=True,
        turn=min(0.12, 6 / length),
    )
    series = np.polynomial.chebyshev.chebfit(node, (waves / plain(some)).T, 17)
    u = (np.sqrt(rare**2 - p * p) - middle) / half
    return (np.polynomial.chebyshev.chebval(u, series) * plain(p)) @ light
