"""CELL.toml with two ranges of sizes to a library over both: what is swept, written and
said.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from metalens.cell import Cell
from metalens.commands.common import DistributedOptions
from metalens.core import store
from metalens.library import Sweep, axes
from metalens.library.axes import AxesLibrary

LEAST_USABLE = 0.5  # of the pairs of sizes, below which a library is no library
NM = 1e3


def run(
    options: DistributedOptions,
    target: Path,
    cell: Cell,
    sweep: Sweep,
    about: store.Provenance,
) -> int:
    """Sweep and write; exit 1 where most bars miss the tolerance, or a pair held out
    lies above its bar.

    Args:
        options: of the command line.
        target: output file.
        cell: unit cell of the lens.
    """
    from metalens.library import plots

    with options.claim(target, beside=(".png",)) as draft, options.shared():
        start = time.perf_counter()
        journal = target.with_name(target.name + ".resume")
        made = axes.sweep_two_sizes(
            cell, sweep, console=options.console, checkpoint=journal
        )
        seconds = time.perf_counter() - start
        made = dataclasses.replace(made, provenance=about)
        axes.save(draft.path, made)
        plots.axes_library_figure(draft.path.with_suffix(".png"), made)
    return options.console.judged(
        _values(made, seconds), _text(target, made, seconds), library_failures(made)
    )


def library_failures(made: AxesLibrary) -> list[str]:
    """What is wrong with a library, in words; nothing where it serves.

    Args:
        made: what was designed or computed.
    """
    found, share = [], float(made.usable.mean())
    if share < LEAST_USABLE:
        found.append(
            f"error bars of {1 - share:.0%} of the pairs of sizes are above the tolerance {made.sweep.bar:g} "
            f"(median {np.median(made.t_error):.2g}): allow a larger tolerance or take narrower ranges"
        )
    if made.missed:
        found.append(
            f"{made.missed} of {len(made.held_out)} pairs held out lie above their error bar"
        )
    return found


def _values(made: AxesLibrary, seconds: float) -> dict[str, Any]:
    return {
        "engine": "rcwa",
        "entries": made.t_error.size,
        "solves": made.solves,
        "harmonics": made.harmonics,
        "seconds": seconds,
        "usable": float(made.usable.mean()),
        "max_error": float(made.t_error.max()),
        "median_error": float(np.median(made.t_error)),
        "held_out": len(made.held_out),
        "held_out_median_error": float(np.median(made.held_out[:, 3])),
        "held_out_max_error": float(made.held_out[:, 3].max()),
        "held_out_above_bar": made.missed,
        "least_transmission": [float(v) for v in _least(made)],
    }


def _least(made: AxesLibrary) -> list[float]:
    """Least |t| of both polarisations among the usable pairs; 0 where there is none."""
    return [
        float(np.abs(made.t[..., k, k])[made.usable].min(initial=1.0)) for k in (0, 1)
    ]


def _text(target: Path, made: AxesLibrary, seconds: float) -> str:
    x, y, held = NM * made.x_um, NM * made.y_um, made.held_out
    lines = [
        f"{target}: {len(x)} x {len(y)} sizes ({x[0]:.1f}-{x[-1]:.1f} nm along x, {y[0]:.1f}-{y[-1]:.1f} nm along y), "
        f"Jones matrices at {len(made.wavelength_um)} wavelength(s)",
        f"  {made.solves} solves (rcwa, orders within {made.harmonics}), {seconds:.1f} s",
        f"  t within {np.median(made.t_error):.1e} in the median; {made.usable.mean():.1%} of the sizes are within "
        f"{made.sweep.bar:g}, the others are excluded bands of resonances",
        f"  {len(held)} pairs held out: interpolated within {np.median(held[:, 3]):.1e} in the median, "
        f"{held[:, 3].max():.1e} at most, {made.missed} above their bar",
    ]
    return "\n".join(lines)
