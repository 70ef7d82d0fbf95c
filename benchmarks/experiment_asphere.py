"""The radial asphere of the virtual experiment: what a designer without a network would
choose for its field and light.

    python -m benchmarks.experiment_asphere    # makes benchmarks/results/experiment_asphere.json anew, 7 min of a core

Six radial terms on a hyperbolic lens, from several foci, each brought down the mean
over the field of ±25 degrees and
the depths of the eyes of what blur alone can tell, 1 / √(J + 1 / prior²) in mm
(:mod:`benchmarks.design_guide_bound`:
light of 30 nm, the experiment's pixels and exposure). The lens is round and the windows
lie on a square: one eighth of
them stands for all. A bound is not what readers collect, so each start and what became
of it are read by the reference
reader on the true image, and the asphere of least axial error is kept.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from benchmarks.design_guide import CHOICE, imaged, optics_of, scenery, start_of
from benchmarks.design_guide_bound import centres_um, spreads_mm, told
from benchmarks.design_guide_cells import Cell, cell_of
from codesign.evaluate import reader
from codesign.optics.stack import OpticsConfig
from metalens.field import Window
from metalens.ground import store
from metalens.image import Imager
from metalens.psf import Nodes

RESULT = Path(__file__).parent / "results" / "experiment_asphere.json"
STARTS = (
    "focus1000",
    "focus33",
)  # far sources, best of the hyperbolic ones to the reader; the paper's
DEPTHS_MM = (
    12.0,
    27.0,
)  # 98 % of what the frames show, slippage along the axis of ±5.5 mm included
MOST = 40  # iterations


def cell_for(start: str) -> Cell:
    """Six radial terms from a start, in the field and light of the experiment: 4000
    electrons in 3 um, 9² / 3² more.
    """
    return cell_of(f"lens=radial-{start},field=ring,fwhm=30,pitch=12,electrons=36000")


def distinct(at_um: Tensor) -> tuple[Tensor, Tensor]:
    """(points, 2) places that no turn or mirroring of the square takes to each other,
    and the share of all of each.
    """
    folded = at_um.abs().sort(1, descending=True).values.round(decimals=3)
    places, counts = torch.unique(folded, dim=0, return_counts=True)
    return places, counts.double() / len(at_um)


def objective(
    settings: OpticsConfig, cell: Cell, waves: Nodes, window: Window
) -> Callable[[Tensor], Tensor]:
    """Mean bound of the windows' depths in mm, of the coefficients; differentiable."""
    places, share = distinct(centres_um(settings, cell.config, (1.0, 1.0)))

    def bound(place: Tensor) -> Tensor:
        information = told(
            settings, place, places, waves, window, cell.config, DEPTHS_MM
        )
        return share @ spreads_mm(information.double()).mean(1)

    return bound


def optimised(bound: Callable[[Tensor], Tensor], start: Tensor) -> Tensor:
    """Coefficients of a least bound near the start, by BFGS on its exact gradient."""

    def valued(place: np.ndarray) -> tuple[float, np.ndarray]:
        leaf = torch.from_numpy(place.copy()).requires_grad_()
        value = bound(leaf)

        (slope,) = torch.autograd.grad(value, leaf)
        return float(value.detach()), slope.numpy()

    found = minimize(
        valued, start.numpy(), jac=True, method="L-BFGS-B", options={"maxiter": MOST}
    )
    return torch.from_numpy(found.x)


def candidates() -> list[dict[str, Any]]:
    """Every start and the asphere that became of it: bound, and errors of the reference
    reader.
    """
    out: list[dict[str, Any]] = []
    for start in STARTS:
        cell = cell_for(start)
        config = replace(cell.config, seed=CHOICE)
        settings, place = optics_of(cell), start_of(cell)
        whole = imaged(cell, place)
        if not isinstance(whole, Imager):
            raise TypeError("the true image needs a field of PSFs")
        bound = objective(settings, cell, whole.plan.waves, whole.plan.window)
        for name, lens in (
            (start, place),
            (f"asphere from {start}", optimised(bound, place).round(decimals=4)),
        ):
            read = reader.read(imaged(cell, lens), scenery(config), config)
            out.append({"lens": name, "focus_mm": settings.focus_mm, "coefficients_rad": lens.tolist(),
                        "bound_mm": round(float(bound(lens)), 4)} | _rounded(read))  # fmt: skip
            print(json.dumps(out[-1]), flush=True)
    return out


def _rounded(read: reader.Read) -> dict[str, float]:
    errors = ("axial_mm", "lateral_mm", "window_mm")
    return {name: round(float(getattr(read, name).mean()), 4) for name in errors}


def kept() -> dict[str, Any]:
    """The asphere of least axial error, as the result file has it."""
    lines: list[dict[str, Any]] = json.loads(RESULT.read_text("utf-8"))
    return min(
        (line for line in lines if "asphere" in line["lens"]),
        key=lambda line: line["axial_mm"],
    )


def main() -> None:
    """The result file, made anew."""
    torch.set_num_threads(1)
    store.write_text(RESULT, json.dumps(candidates(), indent=1) + "\n")


if __name__ == "__main__":
    main()
