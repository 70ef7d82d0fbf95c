"""Random lenses, windows, films and directions, and their PSFs by a plain
Rayleigh-Sommerfeld sum in one medium.

Where films are drawn they have the index of the medium around them: the library then
goes its way through films, and the sum in one medium stays the right answer.
"""

from dataclasses import dataclass

import numpy as np

from metalens.cell.record import Film, Index
from metalens.optics import Layers


@dataclass(frozen=True)
class RandomCase:
    """maps: (phase_rad, transmission), each (y, x); geometry: of
    :func:`metalens.psf.psf_stack`; index: of the medium behind the lens.
    """

    maps: tuple[np.ndarray, np.ndarray]
    geometry: dict
    tolerance: float
    index: float


def drawn(rng: np.random.Generator) -> RandomCase:
    """One case: round, square or ragged apertures of 10 to 45 um, NA 0.05 to 0.7, in
    focus and out of it, aberrated or rough, up to 25 degrees, tolerances 1e-2 to 1e-9.
    """
    rows, columns = (int(n) for n in rng.integers(40, 110, 2))
    pitch, wave = rng.uniform(0.22, 0.42), rng.uniform(0.5, 1.6)
    index = float(rng.choice([1.0, 1.0, rng.uniform(1.2, 1.6)]))
    x = (np.arange(columns) - (columns - 1) / 2) * pitch
    y = (np.arange(rows) - (rows - 1) / 2)[:, None] * pitch
    half = max(rows, columns) * pitch / 2
    distance = half * rng.uniform(1.1, 12)
    wish = distance * rng.uniform(0.8, 1.3)
    u, v = x / half, y / half
    phase = -2 * np.pi * index / wave * np.sqrt(x**2 + y**2 + wish**2)
    kind = rng.choice(["smooth", "vortex", "rough"])
    if kind == "smooth":
        phase = phase + rng.normal(0, 4) * u**3 + rng.normal(0, 4) * u * v**2
    elif kind == "vortex":
        phase = phase + int(rng.integers(1, 4)) * np.arctan2(v, u)
    else:
        phase = phase + rng.normal(0, rng.uniform(0.1, 2.0), (rows, columns))
    level = rng.uniform(0.4, 1.0, (rows, columns))
    if rng.random() < 0.7:
        level = level * (np.hypot(x, y) < min(rows, columns) * pitch / 2)
    if rng.random() < 0.3:
        level = level * (rng.random((rows, columns)) < 0.8)
    counts = int(rng.integers(1, 4))
    depths = half * 10 ** rng.uniform(0.7, 2.5, counts)
    nearest = depths.min()
    if rng.random() < 0.3:
        depths[0] = np.inf
    geometry = {
        "pitch_um": pitch,
        "wavelength_um": wave,
        "sensor_distance_um": distance,
        "depths_um": depths,
        "angle_rad": tuple(rng.uniform(-0.3, 0.3, 2)),
        "window_um": half * rng.uniform(0.15, 1.4),
        "samples": int(rng.integers(12, 30)),
        "offset_um": tuple(rng.uniform(-0.3, 0.3, 2) * half),
    }
    if index > 1 or rng.random() < 0.4:
        front = Film(Index(1.0), rng.uniform(0.1, 0.9) * nearest)
        behind = Film(Index(index), rng.uniform(0.1, 0.8) * distance)
        geometry["layers"] = Layers((front,), (behind,), cover=Index(index))
    return RandomCase((phase, level), geometry, float(10 ** rng.uniform(-9, -2)), index)


def plain_psfs(case: RandomCase) -> tuple[np.ndarray, np.ndarray]:
    """(depth, y, x) PSFs of sum 1, and (depth,) energies for unit irradiance, um².

    U = Σ p² T e^{iφ} e^{ik0 (s - s0)} d/(2πr²) (1/r - ik) e^{ikr}, k of the medium
    behind, s from the source in air; the window follows the chief ray by Snell's law.
    """
    (phase, level), g = case.maps, case.geometry
    rows, columns = phase.shape
    x = (np.arange(columns) - (columns - 1) / 2) * g["pitch_um"]
    y = (np.arange(rows) - (rows - 1) / 2)[:, None] * g["pitch_um"]
    k0, d = 2 * np.pi / g["wavelength_um"], g["sensor_distance_um"]
    k, tangents = case.index * k0, np.tan(g["angle_rad"])
    sines = tangents / np.sqrt(1 + (tangents**2).sum())
    cosine = np.sqrt(case.index**2 - (sines**2).sum())
    cx, cy = d * sines / cosine + np.array(g["offset_um"])
    count = g["samples"]
    step = g["window_um"] / count
    places = (np.arange(count) - (count - 1) / 2) * step
    there = level > 0
    px, py = (np.broadcast_to(a, phase.shape)[there] for a in (x, y))
    lights = []
    for z in g["depths_um"]:
        if np.isinf(z):
            path = sines[0] * px + sines[1] * py
        else:
            whole = z * np.sqrt(1 + (tangents**2).sum())
            more = px**2 + py**2 + 2 * z * (px * tangents[0] + py * tangents[1])
            path = more / (np.sqrt(whole**2 + more) + whole)
        lights.append(level[there] * np.exp(1j * (phase[there] + k0 * path)))
    lights = np.array(lights)
    out = np.empty((len(lights), count, count))
    for i, b in enumerate(places + cy):
        for j, a in enumerate(places + cx):
            r = np.sqrt((a - px) ** 2 + (b - py) ** 2 + d**2)
            h = d / (2 * np.pi * r**2) * (1 / r - 1j * k) * np.exp(1j * k * r)
            out[:, i, j] = abs(lights @ h) ** 2 * g["pitch_um"] ** 4
    energy = out.sum((1, 2))
    return out / energy[:, None, None], energy * step**2
