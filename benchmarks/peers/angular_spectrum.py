"""Textbook angular spectrum on the zero-padded lattice of the pillars (Goodman,
Introduction to Fourier Optics, eq. 3-74)."""

import numpy as np

from metalens import propagate
from metalens.core.arrays import Array


def free_space_transfer(
    case: propagate.PropagationCase, count: tuple[int, int]
) -> Array:
    """H(fy, fx) = exp(ik_z d) on the FFT grid of ``count`` (y, x) samples; evanescent
    waves decay.
    """
    fy, fx = (
        np.fft.fftfreq(n, step) for n, step in zip(count, case.steps_um, strict=True)
    )
    square = case.wavelength_um**-2 - fx**2 - fy[:, None] ** 2
    return np.asarray(
        np.exp(2j * np.pi * np.emath.sqrt(square) * case.sensor_distance_um)
    )


def angular_spectrum(
    phase_rad: Array,
    transmission: Array,
    *,
    pad: int = 2,
    single: bool = False,
    **geometry: object,
) -> Array:
    """(depth, y, x) field on a window on the lattice of the pillars, of lenses without
    films; arguments as :func:`metalens.propagate.make_case`.
    """
    case = propagate.make_case(phase_rad.shape, **geometry)  # type: ignore[arg-type]
    ny, nx = case.shape
    kind = np.complex64 if single else np.complex128
    h = free_space_transfer(case, (pad * ny, pad * nx)).astype(kind)
    y, x = case.pillars_um
    rows, columns = (
        np.rint((c + at - first[0]) / step).astype(int) % (pad * len(first))
        for c, at, first, step in zip(
            case.centre_um[::-1], case.window_um, (y, x), case.steps_um, strict=True
        )
    )
    out = []
    for inverse in case.inverse_depths_per_um:
        path = propagate.paths.from_source(case, x, y[:, None], case.tangents, inverse)
        light = transmission * np.exp(1j * (phase_rad + case.wavenumber * path))
        field = np.fft.ifft2(np.fft.fft2(light.astype(kind), h.shape) * h)
        out.append(field[np.ix_(rows, columns)])
    return np.array(out)
