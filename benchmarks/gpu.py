"""PSFs, images and training on a GPU beside the processor of the same machine: ``python -m benchmarks gpu``.

The error of a row is its difference from what the processor computes of the same.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch

from benchmarks import Row, image
from codesign.batches import Batch, Scenes
from codesign.train import Trainer, device_of, place, run
from metalens.design import Focus
from metalens.field import Layers, Optics, PillarWave, SmoothWave, Window, imager
from metalens.field.plan import spectral
from metalens.ground import config
from metalens.image import Frames
from metalens.psf import Nodes, Source, spectrum

BATCH = 64  # frames that are imaged at once
FIRST, STEPS = 3, 8  # of a training: those that are left out of the time, and those in it
PAPER = (480.0, 2500.0)  # MMACs of the planned runs


def rows() -> Iterator[Row]:
    """Rows of this topic.

    Raises:
        ConfigError: there is no GPU.
    """
    there = device_of("cuda")
    yield from _training(there)
    yield from _images(there)
    yield from _psfs(there)


def _seconds(work: Callable[[], object], *, repeats: int = 3) -> float:
    """Of the fastest repeat, after one that is not counted; until the GPU is done."""
    found = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        torch.cuda.synchronize()
        found.append(time.perf_counter() - start)
    return min(found[1:])


def _psfs(there: torch.device) -> Iterator[Row]:
    """25 field points x 9 wavelengths x 21 depths of ``benchmarks image``, from a smooth phase and from pillars."""
    grid = torch.meshgrid(*2 * [torch.linspace(-500, 500, 5, dtype=torch.float64)], indexing="ij")
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

        def psfs(device: torch.device, wave: Any = wave, window: Window = window) -> torch.Tensor:
            return spectral(Optics(wave(), Layers(), 2e3), at.to(device), depths, waves, window).cpu()

        want = psfs(torch.device("cpu"))
        for device in (torch.device("cpu"), there):
            seconds = _seconds(lambda device=device, psfs=psfs: psfs(device), repeats=1)  # type: ignore[misc]
            error = float((psfs(device) - want).norm() / want.norm())
            yield _row(f"PSFs of {name}", "25 field points x 9 wavelengths x 21 depths", device, seconds, error)


def _images(there: torch.device) -> Iterator[Row]:
    """Frames a second of the true image of ``benchmarks image``."""
    wave = SmoothWave(Focus(0.85, 2e3, 33e3), 500.0)
    few = image.frames()
    seen = Frames(*(getattr(few, name).repeat(BATCH // image.FRAMES, 1, 1, 1) for name in Frames.__slots__))
    for tolerance in (1e-2, 2e-3):
        for device in (torch.device("cpu"), there):
            about: dict[str, Any] = {"spectrum": Source(850.0, 30.0), "tolerance": tolerance, "device": device}
            imager(wave, replace(image.GRID, samples=(24, 24)), **about)  # compiles
            start = time.perf_counter()
            made = imager(wave, image.GRID, **about)
            prepared = time.perf_counter() - start
            with torch.no_grad():
                if device.type == "cpu":
                    want = made(seen)
                given = seen.to(device)
                seconds = _seconds(lambda made=made, given=given: made(given)) / BATCH  # type: ignore[misc]
                error = float((made(given).cpu() - want).norm() / want.norm())
            case = f"image 128² of 9 um, ±20°, 30 nm, stated error {made.error:.4f}"
            yield _row(case, f"{1 / seconds:.0f} frames/s", device, seconds, error)
            yield _row("its preparation", f"{len(made.patches)} patches", device, prepared, error)


def _training(there: torch.device) -> Iterator[Row]:
    """A step of the presets, lens and pitch moving with the network; of ``paper`` the cost of the whole training."""
    losses: dict[str, list[float]] = {}
    for device in (torch.device("cpu"), there):
        trainer = _trainer("laptop", {"scenes": {"pool": 256}})
        seconds, losses[device.type] = _trained(trainer, device)
        error = max(abs(b / a - 1) for a, b in zip(losses["cpu"][:3], losses[device.type][:3], strict=True))
        frames = trainer.inner.batch / seconds
        yield _row("a training step, preset laptop", f"{frames:.0f} frames/s", device, seconds, error)
    kept = _Kept(_trainer("paper", {}).scenes)
    case = f"rendering {len(kept.one.slip_mm)} frames of preset paper, beside the step before"
    yield _row(case, f"{len(kept.one.slip_mm) / kept.seconds:.0f} frames/s", torch.device("cpu"), kept.seconds, 0.0)
    for budget in PAPER:
        for kind in ("single precision", "network in bfloat16"):
            trainer = _trainer("paper", {"run": {"budgets_mmacs": [budget]}})
            trainer.scenes, net = kept, trainer.model.net
            if kind != "single precision":
                net.forward = torch.autocast("cuda", torch.bfloat16)(net.forward)
            seconds, found = _trained(trainer, there)
            losses = losses | {kind: found}
            error = max(abs(b / a - 1) for a, b in zip(losses["single precision"][:3], found[:3], strict=True))
            hours = max(seconds, kept.seconds) * trainer.inner.steps / 3600
            method = (
                f"{kind}, frames at hand: {trainer.inner.batch / seconds:.0f} frames/s; {hours:.0f} h with rendering"
            )
            row = _row(f"a training step, preset paper, {budget:g} MMACs", method, there, seconds, error)
            yield replace(row, against="the same in single precision")


class _Kept:
    """One rendered batch, again and again: a step without waiting for its frames; ``seconds``: of its rendering."""

    def __init__(self, scenes: Scenes) -> None:
        self.margin = scenes.margin
        scenes.batch(0, 2)  # compiles
        start = time.perf_counter()
        self.one = scenes.batch(1, 64)
        self.seconds = time.perf_counter() - start

    def batch(self, step: int, size: int) -> Batch:
        """The batch, whatever the step; of 64 frames."""
        return self.one


def _trainer(preset: str, change: dict[str, Any]) -> Trainer:
    table = config.merged(run.preset_table(preset), change)
    made = run.start(config.from_table(table, run.RunConfig, where="benchmarks gpu")).trainer
    schedules = {name: replace(getattr(made.inner, name), start=0.0) for name in ("optics", "pitch")}
    made.inner = replace(made.inner, **schedules)  # from the first step
    made.groups |= {name: (schedule, made.groups[name][1]) for name, schedule in schedules.items()}
    return made


def _trained(trainer: Trainer, device: torch.device) -> tuple[float, list[float]]:
    """Median seconds of a step, and the losses."""
    place(trainer, device)
    marks, losses = [], []
    for record in trainer.run(until=FIRST + STEPS):
        marks.append(time.perf_counter())
        losses.append(record.loss)
    spent = [b - a for a, b in zip(marks[FIRST - 1 : -1], marks[FIRST:], strict=True)]
    return statistics.median(spent), losses


def _row(case: str, method: str, device: torch.device, seconds: float, error: float) -> Row:
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "processor"
    return Row(case, f"{name}: {method}", seconds, error, "the processor", threads=torch.get_num_threads())
