"""Small finished runs for the studies of the closing loop: one network, trained with
one lens, as a run folder.

The settings of every study are made here, from one text over the preset ``smoke``.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from codesign.network.architecture import largest
from codesign.optics import formed
from codesign.optics import stack as trained
from codesign.train import run as runs
from codesign.train.evolution import Candidate, Search
from codesign.train.finish import finish
from metalens import design, lens, library
from metalens.ground import store

TEXT = """
preset = "smoke"
checkpoint_every = 100
[scenes]
pixels = {pixels}
margin = {margin}
pool = {pool}
slip_mm = {slip_mm}
gaze_deg = {gaze_deg}
[space]
widths = [{width}]
depths = [2]
expansions = [3]
kernels = [5]
resolution = [1.0, 1.0]
[run]
pitch_um = {pitch_um}
frozen = ["pitch"]
budgets_mmacs = [{budget}]
[inner]
steps = {steps}
batch = {batch}
seed = {seed}
slip_scale_mm = {slip_scale_mm}
optics_weight = {optics_weight}
[inner.optics]
rate = {rate}
start = 0.12
end = 0.8
[optics]
image = "{image}"
fwhm_nm = {fwhm_nm}
sample_um = {pitch_um}
window_samples = {window}
depth_count = 16
focus_mm = {focus_mm}
polynomials = {polynomials}
family = "{family}"
"""
BUDGET = 20.0  # MMACs that the one network stays below
WINDOW_UM = 300.0  # of the PSFs


@dataclass(frozen=True, slots=True)
class Recipe:
    """What the studies vary.

    focus_mm: of the hyperbolic lens that training starts from. moves: whether training
    moves the lens as well.
    pitch_um: of pixels and samples. edge_um: of the image. width: of the network.
    slip_mm, gaze_deg: reach of slippage
    and gaze. rate: largest step of a lens that moves, rad. optics_weight: of the optics
    loss. steps: of ``batch``
    frames.
    seed: of weights, frames and noise. image, fwhm_nm: see
    :class:`codesign.optics.stack.OpticsConfig`.
    asphere_rad: coefficients of the radial terms that a lens starts from; none for the
    hyperbolic one, which moves in
    35 terms of free form.
    """

    focus_mm: float
    moves: bool = False
    pitch_um: float = 18.0
    edge_um: float = 1152.0
    width: float = 0.35
    steps: int = 2000
    pool: int = 4096
    slip_mm: tuple[float, float, float] = (2.0, 1.5, 3.5)
    gaze_deg: tuple[float, float] = (18.0, 13.0)
    rate: float = 0.02
    optics_weight: float = 0.05
    batch: int = 32
    seed: int = 0
    image: Literal["true", "uniform"] = "uniform"
    fwhm_nm: float = 0.0
    asphere_rad: tuple[float, ...] = ()

    @property
    def toml(self) -> str:
        """RUN.toml."""
        pixels = round(self.edge_um / self.pitch_um)
        return TEXT.format(
            pixels=pixels, margin=pixels // 8, pool=self.pool, slip_mm=list(self.slip_mm), gaze_deg=list(self.gaze_deg),
            width=self.width, pitch_um=self.pitch_um, budget=BUDGET, steps=self.steps,
            slip_scale_mm=[round(s / 3**0.5, 2) for s in self.slip_mm], rate=self.rate if self.moves else 0.0,
            optics_weight=self.optics_weight, batch=self.batch, seed=self.seed, image=self.image, fwhm_nm=self.fwhm_nm,
            window=2 * int(WINDOW_UM / self.pitch_um / 2) + 1, focus_mm=self.focus_mm,
            polynomials=len(self.asphere_rad) or 35 * self.moves, family="radial" if self.asphere_rad else "free",
        )  # fmt: skip


def finished(folder: Path, recipe: Recipe) -> None:
    """A run folder of these settings, trained with its largest architecture alone; goes
    on where it stopped.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store.write_text(folder / "run.toml", recipe.toml)
    settings = runs.load(folder / "run.toml")
    path = folder / "checkpoint.safetensors"
    going = runs.resume(path, settings) if path.exists() else _begun(settings, recipe)
    chosen = largest(settings.space)
    going.trainer.architecture = chosen
    for record in runs.train(going, path):
        if record.step % 100 == 0:
            print(record.step, f"{record.task:.3f}", flush=True)
    going.searches = [Search((Candidate(chosen, 0.0, going.macs(chosen)),), {})]
    runs.save(path, going)
    if not (folder / "lens.h5").exists():
        _design(folder / "lens.h5", settings, runs.coefficients(going).numpy())
    scenes, coefficients = settings.scenes, runs.coefficients(going)
    side = scenes.pixels + 2 * scenes.margin
    said = formed.described(settings.optics, coefficients, side, margin=scenes.margin)
    store.write_text(
        folder / "result.json", json.dumps({"rows": finish(going), "image": said})
    )


def _begun(settings: runs.RunConfig, recipe: Recipe) -> runs.Run:
    """A run before its first step, behind the recipe's lens."""
    fresh = runs.start(settings)
    if recipe.asphere_rad:
        with torch.no_grad():
            fresh.trainer.model.coefficients_rad.copy_(
                torch.tensor(recipe.asphere_rad, dtype=torch.float64)
            )
    return fresh


def _design(path: Path, settings: runs.RunConfig, coefficients: np.ndarray) -> None:
    made = library.sweep(library.DEFAULT_CELL, wavelengths_um=(0.85,))
    phase = trained.phase_of(settings.optics, coefficients)
    aperture = settings.optics.aperture_mm * 1e3
    shape = settings.optics.focus
    lens.save(
        path,
        design.make(
            phase,
            shape,
            aperture_um=aperture,
            cell=made.cell,
            proxy=library.proxy_of(made),
        )[0],
    )
