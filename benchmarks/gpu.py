"""PSFs and images on a GPU beside the processor of the same machine: ``python -m
benchmarks gpu``.

The error of a row is its difference from what the processor computes of the same.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch

from benchmarks import Row, image
from codesign.train import device_of
from metalens.design import Focus
from metalens.field import Layers, Optics, PillarWave, SmoothWave, Window, imager
from metalens.field.plan import spectral
from metalens.image import Frames
from metalens.psf import Nodes, Source, spectrum

BATCH = 64  # frames that are imaged at once


def rows() -> Iterator[Row]:
    """Rows of this topic.

    Raises:
        ConfigError: there is no GPU.
    """
    there = device_of("cuda")
    yield from _images(there)
    yield from _psfs(there)


def _timed(
    work: Callable[[], torch.Tensor], *, repeats: int = 3
) -> tuple[float, torch.Tensor]:
    """Seconds of the fastest repeat, after one that is not counted, until the GPU is
    done; and what was found.
    """
    spent = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        found = work()
        torch.cuda.synchronize()
        spent.append(time.perf_counter() - start)
    return min(spent[1:]), found.cpu()


def _psfs(there: torch.device) -> Iterator[Row]:
    """25 field points x 9 wavelengths x 21 depths of ``benchmarks image``, from a
    smooth phase and from pillars.
    """
    grid = torch.meshgrid(
        *2 * [torch.linspace(-500, 500, 5, dtype=torch.float64)], indexing="ij"
    )
    at = torch.stack(grid, -1).flatten(0, 1)
    waves = Nodes(*spectrum.gauss(*spectrum.weight(Source(850.0, 30.0)), 9), 0.0)
    depths = 1 / torch.linspace(1 / 15e3, 1 / 28e3, 21, dtype=torch.float64)
    smooth = SmoothWave(Focus(0.85, 2e3, 33e3), 500.0)
    lens = image.pillar_lens(smooth.focus, smooth.radius_um)
    made: tuple[tuple[str, Callable[[], Any], int], ...] = (
        ("a smooth phase", lambda: smooth, 0),
        ("pillars, one scalar", lambda: PillarWave(lens), 0),
        ("pillars, flux of both polarisations", lambda: PillarWave(lens), 2),
    )
    for name, wave, components in made:
        window = Window(image.GRID.window, image.GRID.step_um, components=components)

        def psfs(
            device: torch.device, wave: Any = wave, window: Window = window
        ) -> torch.Tensor:
            return spectral(
                Optics(wave(), Layers(), 2e3), at.to(device), depths, waves, window
            ).cpu()

        want: torch.Tensor | None = None
        for device in (torch.device("cpu"), there):
            seconds, found = _timed(
                lambda device=device, psfs=psfs: psfs(device), repeats=1
            )  # type: ignore[misc]
            want = found if want is None else want
            error = float((found - want).norm() / want.norm())
            yield row(
                f"PSFs of {name}",
                "25 field points x 9 wavelengths x 21 depths",
                device,
                seconds,
                error,
            )


def _images(there: torch.device) -> Iterator[Row]:
    """Frames a second of the true image of ``benchmarks image``."""
    wave = SmoothWave(Focus(0.85, 2e3, 33e3), 500.0)
    few = image.frames()
    seen = Frames(
        *(
            getattr(few, name).repeat(BATCH // image.FRAMES, 1, 1, 1)
            for name in Frames.__slots__
        )
    )
    for tolerance in (1e-2, 2e-3):
        want: torch.Tensor | None = None
        for device in (torch.device("cpu"), there):
            about: dict[str, Any] = {
                "spectrum": Source(850.0, 30.0),
                "tolerance": tolerance,
                "device": device,
            }
            imager(wave, replace(image.GRID, samples=(24, 24)), **about)  # compiles
            start = time.perf_counter()
            made = imager(wave, image.GRID, **about)
            prepared = time.perf_counter() - start
            with torch.no_grad():
                given = seen.to(device)
                seconds, found = _timed(lambda made=made, given=given: made(given))  # type: ignore[misc]
            want = found if want is None else want
            seconds, error = seconds / BATCH, float((found - want).norm() / want.norm())
            case = f"image 128² of 9 um, ±20°, 30 nm, stated error {made.error:.4f}"
            yield row(case, f"{1 / seconds:.0f} frames/s", device, seconds, error)
            yield row(
                "its preparation",
                f"{len(made.patches)} patches",
                device,
                prepared,
                error,
            )


def row(
    case: str, method: str, device: torch.device, seconds: float, error: float
) -> Row:
    """One that names the GPU, or says that it is the processor's."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "processor"
    return Row(
        case,
        f"{name}: {method}",
        seconds,
        error,
        "the processor",
        threads=torch.get_num_threads(),
    )
