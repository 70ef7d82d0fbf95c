"""The true image: frames a second beside the error that the imager states, and its
preparation.
"""

import math
import time
from collections.abc import Iterator

import numpy as np
import torch

from benchmarks import Row, fastest
from metalens.cell import Cell, Index
from metalens.design import Focus, profiles
from metalens.image import Frames, Grid, Optics, PillarWave, SmoothWave, Window, imager
from metalens.image.model_error import JudgedPsfs, polarisation_error, transform_error
from metalens.image.plan import sum_over_spectrum
from metalens.lens import DiameterMap, Lens
from metalens.library import Proxy
from metalens.optics import Layers
from metalens.psf import Source, SpectralNodes, spectrum

FRAMES = 8
GRID = Grid((128, 128), 9.0, (15e3, 28e3), margin=16, window=41)


def _led_nodes() -> SpectralNodes:
    """Nine nodes of an LED of 30 nm at 850 nm."""
    weight = spectrum.spectral_weight(Source(850.0, 30.0))
    return SpectralNodes(*spectrum.discrete_gauss_rule(*weight, 9), 0.0)


def rows() -> Iterator[Row]:
    """128² samples of 9 um, ±20° to the sides of what is rendered, a diode of 30 nm,
    lens of 1 mm at 2 mm, NA 0.24.
    """
    wave = SmoothWave(Focus(0.85, 2e3, 33e3), 500.0)
    yield points_row(wave)
    yield from polarised_rows(wave)
    for tolerance, goal in ((1e-2, 60), (2e-3, 25)):
        start = time.perf_counter()
        made = imager(wave, GRID, spectrum=Source(850.0, 30.0), tolerance=tolerance)
        prepared = time.perf_counter() - start
        seen = frames()
        with torch.no_grad():
            seconds = fastest(lambda made=made, seen=seen: made(seen)) / FRAMES  # type: ignore[misc]
        yield Row(
            "image 128² of 9 um, ±20°, 30 nm",
            f"{len(made.light.kernels)} kernels",
            seconds,
            made.error,
            "estimate; held to every point's own PSF by tests",
            threads=torch.get_num_threads(),
            goal=f"{goal} frames/s at {tolerance:g}: {1 / seconds:.0f}",
        )
        nodes = len(made.plan.y_um) * len(made.plan.x_um)
        depth = len(made.plan.depths_um)
        waves = len(made.plan.waves.weights)
        method = f"{nodes} field points x {depth} depths x {waves} wavelengths"
        yield Row(
            "its preparation",
            method,
            prepared,
            made.error,
            "as above",
            threads=torch.get_num_threads(),
        )


def points_row(wave: SmoothWave) -> Row:
    """PSFs over 25 field points, 9 wavelengths and 21 depths, against ones whose rays
    are seen from beside.
    """
    at = torch.stack(
        torch.meshgrid(
            *2 * [torch.linspace(-500, 500, 5, dtype=torch.float64)], indexing="ij"
        ),
        -1,
    )
    waves = _led_nodes()
    optics = Optics(wave, Layers(), 2e3)
    window = Window(GRID.window, GRID.step_um)
    depths = 1 / torch.linspace(1 / 15e3, 1 / 28e3, 21, dtype=torch.float64)
    seconds = fastest(
        lambda: sum_over_spectrum(optics, at.flatten(0, 1), depths, waves, window),
        repeats=1,
    )
    error = transform_error(
        JudgedPsfs(optics, waves, window, (at.flatten(0, 1)[::6], depths[::10]))
    )
    method = "25 field points x 9 wavelengths x 21 depths"
    judge, count = "rays seen from beside", torch.get_num_threads()
    return Row(
        "PSFs of a smooth phase",
        method,
        seconds,
        error,
        judge,
        threads=count,
        goal="3 s on two threads",
    )


def polarised_rows(wave: SmoothWave) -> Iterator[Row]:
    """The same PSFs from pillars, by one scalar and by the flux of both polarisations;
    against all components.
    """
    at = torch.stack(
        torch.meshgrid(
            *2 * [torch.linspace(-500, 500, 5, dtype=torch.float64)], indexing="ij"
        ),
        -1,
    )
    waves = _led_nodes()
    depths = 1 / torch.linspace(1 / 15e3, 1 / 28e3, 21, dtype=torch.float64)
    pillars = pillar_lens(wave.focus, wave.radius_um)
    for count in (0, 2, 3):
        window = Window(GRID.window, GRID.step_um, components=count)
        optics = Optics(
            PillarWave(pillars), Layers(), 2e3
        )  # nothing kept of the last row
        seconds = fastest(
            lambda o=optics, w=window: sum_over_spectrum(
                o, at.flatten(0, 1), depths, waves, w
            ),
            repeats=1,
        )  # type: ignore[misc]
        error = polarisation_error(
            JudgedPsfs(optics, waves, window, (at.flatten(0, 1)[::6], depths[::10]))
        )
        name = (
            f"flux of both polarisations, {count} of {window.whole} components"
            if count
            else "one scalar"
        )
        method = f"{name}; 25 field points x 9 wavelengths x 21 depths"
        judge, threads = "all components", torch.get_num_threads()
        yield Row(
            "PSFs of pillars",
            method,
            seconds,
            error,
            judge,
            threads=threads,
            goal="60 s from pillars",
        )


def pillar_lens(focus: Focus, radius_um: float) -> Lens:
    """A hyperbolic lens of pillars whose phase is linear in the diameter."""
    pitch, low = 0.4, 6.0 - 3.2 * math.pi
    x = (
        np.arange(2 * math.floor(radius_um / pitch) + 1) - math.floor(radius_um / pitch)
    ) * pitch
    wanted = np.remainder(profiles.hyperbolic_phase(x, x[:, None], focus), 2 * math.pi)
    wanted += 2 * math.pi * np.ceil((low - wanted) / (2 * math.pi))
    diameter = np.where(
        np.hypot(x, x[:, None]) <= radius_um,
        0.2 + 0.12 * (wanted - 6.0) / (3.2 * math.pi),
        0.0,
    )
    flat = Proxy(
        np.array([[6.0, 3.2 * math.pi]]),
        np.array([[0.9, -0.03]]),
        (0.08, 0.32),
        (0.7, 1.0),
        1e-6,
        1e-6,
    )
    cell = Cell(pitch_um=pitch, pillar=Index(3.6), substrate=Index(1.45))
    distance = focus.sensor_distance_um
    source = focus.source_distance_um
    return Lens(
        DiameterMap(diameter, pitch),
        cell,
        flat,
        focus.wavelength_um,
        distance,
        source,
        "hyperbolic",
    )


def frames() -> Frames:
    """A lid over an eyeball-like far sheet, textured, curved in depth; margin included."""
    draw = torch.Generator().manual_seed(4)
    n = GRID.samples[0] + 2 * GRID.margin
    y, x = torch.meshgrid(
        torch.arange(n) - n / 2, torch.arange(n) - n / 2, indexing="ij"
    )
    lid = torch.sigmoid(-(y + 30 - 0.005 * x**2))
    cover = torch.stack([lid, 1 - lid]).expand(FRAMES, 2, n, n).contiguous()
    fine = torch.nn.functional.interpolate(
        torch.rand(FRAMES, 2, 40, 40, generator=draw),
        size=(n, n),
        mode="bicubic",
        align_corners=False,
    )
    depth = torch.stack([17e3 + 10 * (y + n / 2), 18e3 + (x**2 + y**2) / n**2 * 8e3])
    return Frames(
        cover * fine.clamp_min(0), cover, depth.expand(FRAMES, 2, n, n).contiguous()
    )
