"""Every scene point through its own PSF, summed in float64: judges the image engine and
shares no code with it.

The aperture on a fine lattice, each point's spherical wave, the lens phase by its
formula, angular spectrum to the
sensor (through films: the phase of each plane wave in each film), |U|² added; at the
end the box of a
scene's sample and that of a sensor's. One full transform a point: for images of some
hundred points.
"""

import numpy as np

from .films import rise


def _rotated(e, start, end):
    """e as the rotation of unit vectors start to end takes it: e cos + u x e + u
    (u·e)/(1 + cos) (Rodrigues).
    """
    unit, cosine = np.cross(start, end, axis=0), (start * end).sum(0)
    return (
        e * cosine + np.cross(unit, e, axis=0) + unit * (unit * e).sum(0) / (1 + cosine)
    )


class Referee:
    """lens: radius, sensor distance, focus of the source, all um; films behind as
    (index, thickness), air the rest.
    """

    def __init__(
        self,
        *,
        radius,
        distance,
        focus,
        design_wavelength,
        films=(),
        fine=0.4,
        count=384,
        extra=None,
        looked_at=None,
    ):
        """looked_at: half width, um, of what is wanted about a place: plane waves that
        no ray takes from the lens there
        are faded out, where they would come back over the lattice's edge."""
        self.radius, self.distance, self.focus, self.films = (
            radius,
            distance,
            focus,
            films,
        )
        self.looked_at = looked_at
        self.k0, self.fine, self.count, self.extra = (
            2 * np.pi / design_wavelength,
            fine,
            count,
            extra,
        )
        axis = (np.arange(count) - count // 2) * fine
        self.x, self.y = np.meshgrid(axis, axis)
        self.open = self._coverage()

    def _coverage(self):
        """Share of each fine cell inside the aperture, by 5 x 5 points."""
        off = (np.arange(5) - 2) / 5 * self.fine
        return np.mean(
            [np.hypot(self.x + a, self.y + b) <= self.radius for a in off for b in off],
            axis=0,
        )

    def lens_phase(self):
        r2 = self.x**2 + self.y**2
        phase = -self.k0 * (
            np.sqrt(r2 + self.distance**2) + np.sqrt(r2 + self.focus**2)
        )
        return phase if self.extra is None else phase + self.extra(self.x, self.y)

    def _lands(self, p, q, s, place):
        """1 for plane waves (in air) whose rays fall from the lens on what is looked
        at, 0 for those that wrap.
        """
        if self.looked_at is None:
            return 1.0
        beside = np.hypot(
            self.distance * p / s - place[0], self.distance * q / s - place[1]
        )
        near = self.radius + self.looked_at
        u = np.clip((beside - near) / (self.count * self.fine - 2 * near), 0, 1)
        return 1 - rise(u)

    def intensity(self, place, depth, wavelength):
        """|U|² on the fine lattice about `place` (x, y on the sensor) for a source seen
        in the direction of `place`.
        """
        k = 2 * np.pi / wavelength
        reduced = self.distance - sum(t * (1 - 1 / n) for n, t in self.films)
        tx, ty = place[0] / reduced, place[1] / reduced
        source = np.sqrt(
            (self.x + tx * depth) ** 2 + (self.y + ty * depth) ** 2 + depth**2
        )
        wave = self.open * np.exp(1j * (k * source + self.lens_phase()))
        f = np.fft.fftfreq(self.count, self.fine)
        fx, fy = np.meshgrid(f, f)
        p2 = wavelength**2 * (fx**2 + fy**2)
        air = self.distance - sum(t for _, t in self.films)
        path = air * np.sqrt(np.maximum(1 - p2, 0)) + sum(
            t * np.sqrt(np.maximum(n**2 - p2, 0)) for n, t in self.films
        )
        move = np.exp(1j * k * path + 2j * np.pi * (fx * place[0] + fy * place[1])) * (
            p2 < 1
        )
        move = move * self._lands(
            wavelength * fx, wavelength * fy, np.sqrt(np.maximum(1 - p2, 1e-6)), place
        )
        out = np.fft.ifft2(np.fft.fft2(np.fft.ifftshift(wave)) * move)
        # the wave reaches the sensor of a lattice that wraps: the caller keeps the
        # window well inside
        return np.abs(np.fft.fftshift(out)) ** 2 / self.open.sum()

    def polarised(self, place, depth, wavelength):
        """|Ex|² + |Ey|² + |Ez|² as :meth:`intensity`, mean of both polarisations, over that on the lens."""
        electric, _, level = self._fields(place, depth, wavelength)
        return sum((np.abs(part) ** 2).sum(0) for part in electric) / 2 / level

    def flux(self, place, depth, wavelength):
        """Re(Ex Hy* - Ey Hx*) as :meth:`intensity`, mean of both polarisations, over
        the power along z on the lens.
        """
        electric, magnetic, _ = self._fields(place, depth, wavelength)
        total = sum(
            (e[0] * h[1].conj() - e[1] * h[0].conj()).real
            for e, h in zip(electric, magnetic, strict=True)
        )
        return total / 2 / self.open.sum()

    def _fields(self, place, depth, wavelength):
        """E and H of both polarisations on the fine lattice about `place`, and |E|² on
        the lens.

        At each point of the lens the field across the source's ray is turned with the
        ray to that of the phase's
        slope, its power along z kept; behind it plane waves have Ez = -(p Ex + q Ey) /
        s and H = (p, q, s) x E. In air.
        """
        k, h, fine = 2 * np.pi / wavelength, 1e-3, self.fine
        tx, ty = place[0] / self.distance, place[1] / self.distance
        ax, ay = self.x + tx * depth, self.y + ty * depth
        source = np.sqrt(ax**2 + ay**2 + depth**2)
        a = np.stack([ax, ay, np.full_like(ax, depth)]) / source
        slope = []
        for dx, dy in ((h, 0), (0, h)):
            rise = 0
            for d in (self.distance, self.focus):
                ends = [
                    np.sqrt((self.x + u * dx) ** 2 + (self.y + u * dy) ** 2 + d**2)
                    for u in (-1, 1)
                ]
                rise = rise + (ends[0] - ends[1]) / (2 * h)
            slope.append(self.k0 / k * rise)
        b = np.stack([a[0] + slope[0], a[1] + slope[1], np.zeros_like(ax)])
        b[2] = np.sqrt(np.maximum(1 - b[0] ** 2 - b[1] ** 2, 1e-3))
        f = np.fft.fftfreq(self.count, fine)
        fx, fy = np.meshgrid(f, f)
        p, q = wavelength * fx, wavelength * fy
        runs = p**2 + q**2 < 0.998
        s = np.sqrt(np.where(runs, 1 - p**2 - q**2, 1))
        move = runs * np.exp(
            1j * k * self.distance * s + 2j * np.pi * (fx * place[0] + fy * place[1])
        )
        move = move * self._lands(p, q, s, place)
        scalar = self.open * np.exp(1j * (k * source + self.lens_phase()))
        electric, magnetic = [], []
        straight = np.zeros_like(a)
        straight[2] = 1.0
        for e in np.eye(3)[:2]:
            out = _rotated(_rotated(e[:, None, None] + 0 * a, straight, a), a, b)
            waves = [
                np.fft.fft2(np.fft.ifftshift(scalar * part / np.sqrt(b[2]))) * move
                for part in out[:2]
            ]
            waves.append(-(p * waves[0] + q * waves[1]) / s)
            turned = [q * waves[2] - s * waves[1], s * waves[0] - p * waves[2]]
            electric.append(np.stack([np.fft.fftshift(np.fft.ifft2(w)) for w in waves]))
            magnetic.append(
                np.stack([np.fft.fftshift(np.fft.ifft2(w)) for w in turned])
            )
        return electric, magnetic, (self.open / b[2]).sum()

    def sampled(self, fine, step, window):
        """(window, window) light on samples about the middle of the lattice, from a
        square source as large as they.
        """
        f = np.fft.fftfreq(self.count, self.fine)
        keep = np.sinc(f * step) ** 2
        smooth = (
            np.fft.ifft2(np.fft.fft2(fine) * keep[:, None] * keep).real
            * (step / self.fine) ** 2
        )
        every = round(step / self.fine)
        first = self.count // 2 - (window // 2) * every
        return smooth[
            first : first + window * every : every,
            first : first + window * every : every,
        ]

    def image(self, light, depth, *, step, window, waves, middle=(0.0, 0.0), psf=None):
        """(y, x) irradiance of point sources on the samples: every one with its own
        PSF, cos⁴ and wavelengths.

        psf: :meth:`intensity` (the scalar, if None), :meth:`polarised` or :meth:`flux`.
        """
        psf = psf or self.intensity
        rows, columns = light.shape
        half = window // 2
        out = np.zeros((rows + 2 * half, columns + 2 * half))
        reduced = self.distance - sum(t * (1 - 1 / n) for n, t in self.films)
        for i in range(rows):
            for j in range(columns):
                if light[i, j] == 0:
                    continue
                place = (
                    middle[0] + (j - (columns - 1) / 2) * step,
                    middle[1] + (i - (rows - 1) / 2) * step,
                )
                seen = sum(
                    w * self.sampled(psf(place, depth[i, j], c), step, window)
                    for c, w in waves
                )
                fall = 1 / (1 + (place[0] ** 2 + place[1] ** 2) / reduced**2) ** 2
                out[i : i + window, j : j + window] += light[i, j] * fall * seen
        return out[half : half + rows, half : half + columns]
