"""Axial information: honest against coarse, lens against lens, and the cost of a design step."""

import time

import torch

from benchmarks import Row, fastest
from metalens import design_fisher, fisher, pupil
from metalens.design_fisher import Fisher
from metalens.pupil import Pupil

PUPIL = Pupil(nodes=160)
DEPTHS = torch.arange(16e3, 26.01e3, 1e3, dtype=torch.float64)
HONEST = {"hyperbolic 20 mm": (0.24, 0.09, 0.045), "double helix, 2 zones": (0.29, 0.089, 0.04)}


def rows() -> list[Row]:
    """Rows of this topic; ``error`` of a lens is against the values measured apart, in a paraxial model."""
    flat = torch.zeros(160, 160, dtype=torch.float64)
    x, y = (a.numpy() for a in pupil.coordinates(PUPIL))
    helix = torch.from_numpy(design_fisher.vortices(x, y, radius_um=500.0, zones=2))
    out = []
    for name, phase in (("hyperbolic 20 mm", flat), ("double helix, 2 zones", helix)):
        for k, binning in enumerate((1, 2, 3)):
            settings = Fisher(pixel_um=3.0 * binning)
            start = time.perf_counter()
            made = design_fisher.score(phase, PUPIL, focus_um=20e3, settings=settings)
            seconds, value = time.perf_counter() - start, float(made.information.mean())
            want = HONEST[name][k]
            goal = f"I(z) {value:.3f} per mm², energy {float(made.encircled.min()):.2f} or more"
            out.append(Row(name, f"honest, {binning} x {binning}", seconds, abs(value / want - 1), "apart", goal=goal))
    out.append(_coarse(helix))
    out.append(_step(flat))
    return out


def _coarse(phase: torch.Tensor) -> Row:
    near, far = (
        pupil.psf(phase, PUPIL, depths_um=d, focus_um=20e3, sample_um=3.0, samples=48) for d in (DEPTHS, DEPTHS + 200)
    )
    setting = dict(step_um=200.0, sample_um=3.0, pixel_um=3.0, normalisation="l2")
    claimed = float(fisher.pixel_information(near, far, **setting).mean())  # type: ignore[arg-type]
    honest = float(design_fisher.score(phase, PUPIL, focus_um=20e3, settings=Fisher()).information.mean())
    seconds = fastest(lambda: fisher.pixel_information(near, far, **setting))  # type: ignore[arg-type]
    goal = f"claims {claimed:.2f}, has {honest:.2f}"
    return Row(
        "double helix, 2 zones", "sampled every 3 um, one position", seconds, claimed / honest - 1, "honest", goal=goal
    )


def _step(flat: torch.Tensor) -> Row:
    depths = torch.linspace(16e3, 26e3, 21, dtype=torch.float64)
    phase = flat.clone().requires_grad_(True)

    def work() -> None:
        stack = pupil.psf(phase, PUPIL, depths_um=depths, focus_um=20e3)
        (stack**2).sum().backward()

    return Row("21 depths, forward and gradient", "pupil model, 160² nodes", fastest(work), float("nan"), "-")
