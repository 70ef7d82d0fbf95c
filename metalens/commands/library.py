"""CELL.toml to library.h5: pillar sweep with an error bar on every entry, its proxy,
and a figure.
"""

import dataclasses
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from metalens import library
from metalens.cell import Cell, named_orders, no_resonance_um, substrate_orders
from metalens.commands.common import DistributedOptions, Output
from metalens.core import config, store
from metalens.core.errors import DomainError
from metalens.library import (
    DEFAULT_CELL,
    MOST_ERROR,
    GeometricPhase,
    PillarLibrary,
    ProxyFit,
    ProxyTolerances,
    Sweep,
    axes,
    height_hint,
    workers,
)
from metalens.library import fit as proxy_fit

MOST_UNKNOWN = 0.5  # share of the entries that may be known too little


@dataclass(frozen=True, slots=True)
class CellFile:
    """The content of CELL.toml.

    cell: the pillar cell. sweep: what the library holds. proxy: what its polynomial
    must meet.
    """

    cell: Cell = DEFAULT_CELL
    sweep: Sweep = field(default_factory=Sweep)
    proxy: ProxyTolerances = field(default_factory=ProxyTolerances)


@dataclass(frozen=True)
class Options(DistributedOptions):
    """Options of ``metalens library``.

    Attributes:
        config: CELL.toml; or, with ``--cell``, a unit-cell table of another solver
            (CSV, TSV, NPZ, MAT).
        cell: CELL.toml of the table's cell; its [proxy] counts, its [sweep] does not,
            but for the wavelength of a table that has none.
        columns: names of the table's columns, in place of its header.
        accept_partial_turn: a proxy of less than a turn is no failure (``metalens
            design`` has the same option).
        output: the library file to write; NAME.resume beside it keeps finished curves
            until it is complete.
    """

    config: tyro.conf.Positional[Path]
    output: Output = Path("library.h5")
    accept_partial_turn: bool = False
    cell: Path | None = None
    columns: tuple[str, ...] = ()


def run(options: Options) -> int:
    """Sweep the pillar cell, fit the proxy and write the library.

    Exit status 1 where an error bar misses the stated tolerance or no full turn is
    covered.

    Args:
        options: of the command line.
    """
    if options.cell is not None:
        return _import_table(options, options.cell)
    settings = config.load(options.config, CellFile, empty=False)
    if settings.sweep.lengths_um is not None:
        axes.check_axes_sweep(settings.cell, settings.sweep)
        return _run_two_sizes(options, settings)
    library.check_sweep(settings.cell, settings.sweep)
    target = options.output
    inputs = _inputs(options.config, settings.cell)
    with options.claim(target, companions=(".png",)) as draft, options.shared():
        start = time.perf_counter()
        journal = target.with_name(target.name + ".resume")
        swept = library.sweep(
            settings.cell, settings.sweep, console=options.console, checkpoint=journal
        )
        seconds = time.perf_counter() - start
        if settings.sweep.light == "circular":
            swept = library.with_rotations(swept)
        return _finish(options, draft.path, swept, settings, inputs, seconds)


def _import_table(options: Options, cell_file: Path) -> int:
    """Write the library of a unit-cell table of another solver; the exit status.

    Args:
        options: of the command line, with the table in ``config``.
        cell_file: CELL.toml of its cell.
    """
    settings = config.load(cell_file, CellFile, empty=False)
    imported = library.from_table(
        options.config,
        settings.cell,
        columns=options.columns,
        wavelength_um=settings.sweep.wavelengths_um[0],
    )
    settings = dataclasses.replace(settings, sweep=imported.sweep)
    inputs = _inputs(cell_file, settings.cell) | {
        options.config.name: store.sha256(options.config)
    }
    with options.claim(options.output, companions=(".png",)) as draft:
        return _finish(options, draft.path, imported, settings, inputs, 0.0)


def _finish(
    options: Options,
    path: Path,
    pillars: PillarLibrary,
    settings: CellFile,
    inputs: dict[str, str],
    seconds: float,
) -> int:
    """Fit the proxy, write the library, draw and judge it; the exit status.

    Args:
        options: of the command line.
        path: of the file to write.
        pillars: the library without proxy.
        settings: of CELL.toml.
        inputs: SHA-256 of each input file.
        seconds: time of the sweep.
    """
    fitted: ProxyFit | None = None
    refusal = ""
    try:
        fitted = proxy_fit.fit(pillars, settings.proxy)
    except DomainError as error:
        refusal = str(error)
    added = (*fitted.notes, *filter(None, [fitted.shortfall])) if fitted else (refusal,)
    notes = pillars.notes + added
    provenance = store.Provenance(config.dumps(settings), inputs)
    pillars = dataclasses.replace(
        pillars,
        proxy=fitted.proxy if fitted else None,
        notes=notes,
        provenance=provenance,
    )
    library.save(path, pillars)
    library.plots.library_figure(path.with_suffix(".png"), pillars)
    failures = _failures(
        pillars,
        fitted,
        refusal,
        stated=settings.sweep.tolerance is not None,
        accept_partial_turn=options.accept_partial_turn,
    )
    return options.console.report(
        f"{options.output}: library of {pillars.cell.described}",
        _values(pillars, fitted, seconds),
        notes=_notes(pillars, failures),
        failures=failures,
    )


def _inputs(path: Path, cell: Cell) -> dict[str, str]:
    """Hashes of the config and of the material tables that the cell names."""
    return {
        file.name: store.sha256(file) for file in (path, *workers.material_files(cell))
    }


def _failures(
    pillars: PillarLibrary,
    fitted: ProxyFit | None,
    refusal: str,
    *,
    stated: bool,
    accept_partial_turn: bool = False,
) -> list[str]:
    """Reasons for exit status 1, in words: error bars, phase coverage, conversion.

    Args:
        pillars: the library.
        fitted: its proxy; None where none fits.
        refusal: why none fits.
        stated: whether the tolerance of the error bars was stated.
        accept_partial_turn: whether less than a full turn of phase is no failure.
    """
    failures = []
    if stated and not pillars.converged:
        failures.append(
            f"{_above(pillars)}: allow a larger tolerance or leave the resonances out of diameters_um"
        )
    if fitted is None:
        failures.append(f"no proxy: {refusal}")
    elif fitted.turns < 1 and not accept_partial_turn:
        cure = height_hint(pillars.cell.height_um, fitted.turns)
        if fitted.notes:
            least = no_resonance_um(pillars.cell, pillars.sweep.wavelengths_um[0])
            cure = (
                "it was cut (above); another pitch moves resonances (metalens study compares pitches and heights), and "
                f"none of the lattice's own lies below {least:.3g} um"
            )
        if fitted.smooth_turns >= 1:
            cure = (
                f"the pillars cover {fitted.smooth_turns:.2f}, but it cannot follow them so far within its tolerances: "
                "sweep with more samples, or loosen phase_tolerance_rad and transmission_tolerance"
            )
        failures.append(
            f"the proxy covers {fitted.turns:.2f} of a turn, a lens needs 1: {cure}"
        )
    unknown = float((pillars.t_error > MOST_ERROR).mean())
    if unknown > MOST_UNKNOWN:
        failures.append(
            f"error bars of {unknown:.0%} of the entries are above {MOST_ERROR:g}, whatever is asked for"
        )
    if fitted is not None:
        failures += filter(None, [fitted.shortfall, fitted.proxy.doubt])
    if (
        pillars.turned is not None
        and (bar := _circular(pillars.turned)["converted_error"]) > MOST_ERROR
    ):
        failures.append(
            f"the share that changes hand is known within {bar:.2g} alone, {MOST_ERROR:g} at the most"
        )
    return failures


def _above(pillars: PillarLibrary) -> str:
    """Number of error bars above the tolerance and the largest, in words."""
    missed = pillars.t_error > pillars.sweep.bar
    return (
        f"{int(missed.sum())} of {missed.size} error bars are above the tolerance {pillars.sweep.bar:g} "
        f"(largest {pillars.t_error.max():.2g})"
    )


def _values(
    pillars: PillarLibrary, fitted: ProxyFit | None, seconds: float
) -> dict[str, Any]:
    """Result of a sweep as a dictionary for JSON.

    Args:
        pillars: the library.
        fitted: its proxy; None where none fits.
        seconds: time of the sweep.
    """
    values: dict[str, Any] = {
        "engine": pillars.engine,
        "entries": pillars.t.size,
        "solves": pillars.solves,
        "seconds": seconds,
        "max_error": float(pillars.t_error.max()),
        "median_error": float(np.median(pillars.t_error)),
        "polarizations": list(pillars.polarization),
    }
    shortest, widest = float(pillars.wavelength_um[0]), float(pillars.angle_rad[-1])
    if orders := substrate_orders(pillars.cell, shortest, angle_rad=widest):
        values["lost"] = {
            "orders": named_orders(orders),
            "mean": float(pillars.lost.mean()),
            "most": float(pillars.lost.max()),
        }
    if pillars.turned is not None:
        values["circular"] = _circular(pillars.turned)
    if fitted is not None:
        proxy = fitted.proxy
        values |= {
            "domain_um": list(proxy.domain_um),
            "turns": None if math.isnan(fitted.turns) else fitted.turns,
            "coefficients": proxy.phase_coefficients.size
            + proxy.transmission_coefficients.size,
            "max_phase_error_rad": proxy.max_phase_error_rad,
            "max_transmission_error": proxy.max_transmission_error,
            "entry_error": proxy.entry_error,
            "polarization_spread": fitted.polarization_spread,
        }
    return values


def _notes(pillars: PillarLibrary, failures: list[str]) -> list[str]:
    """What a user of the library must know, in words.

    Args:
        pillars: the library.
        failures: reasons for exit status 1.
    """
    notes = [note for note in pillars.notes if note not in failures]
    stated = any(failure.startswith(_above(pillars)) for failure in failures)
    if not (pillars.converged or stated):
        notes.append(
            f"{_above(pillars)}, which the file does not state: near resonances as a "
            "rule, of narrow walls and shapes without mirrors in more places"
        )
    if (
        pillars.turned is None
        and pillars.polarization == ("x",)
        and not pillars.cell.is_isotropic
    ):
        notes.append(
            "all of it for light along x: these pillars respond to light along y otherwise"
        )
        outline = pillars.cell.outline(float(pillars.diameter_um[-1]))
        if not (outline.keeps(-1, 1) or outline.keeps(1, -1)):
            notes.append(
                f"up to {1 - pillars.energy.min():.0%} of it leaves along y, or is "
                "absorbed: no mirror of the shape lies along x or y; turn it "
                "(angle_rad) until one does"
            )
    return notes


def _circular(turned: GeometricPhase) -> dict[str, Any]:
    """Conversion of circular light by the rotated pillar, for the lesser hand."""
    share, bar = min(turned.efficiency(1.0), turned.efficiency(-1.0))
    unconverted, unconverted_bar = max(
        turned.unconverted(1.0), turned.unconverted(-1.0)
    )
    return {
        "size_um": turned.size_um,
        "converted": share,
        "converted_error": bar,
        "unconverted": unconverted,
        "unconverted_error": unconverted_bar,
        "angles_deg": np.degrees(turned.angle_rad).tolist(),
        "isolated_error": turned.model_error,
        "solver_error": float(turned.t_error.max()),
    }


def _run_two_sizes(options: Options, settings: CellFile) -> int:
    """Sweep over two sizes and write the library.

    Exit status 1 where most error bars miss the tolerance, or a held-out pair lies
    above its bar.
    """
    target = options.output
    inputs = _inputs(options.config, settings.cell)
    with options.claim(target) as draft, options.shared():
        start = time.perf_counter()
        pillars = axes.sweep_two_sizes(
            settings.cell,
            settings.sweep,
            console=options.console,
            checkpoint=target.with_name(target.name + ".resume"),
        )
        seconds = time.perf_counter() - start
        about = store.Provenance(config.dumps(settings), inputs)
        pillars = dataclasses.replace(pillars, provenance=about)
        axes.save_axes_library(draft.path, pillars)
    return options.console.report(
        f"{target}: library over two sizes of {settings.cell.described}",
        _two_size_values(pillars, seconds),
        failures=two_size_failures(pillars),
    )


def two_size_failures(pillars: axes.AxesLibrary) -> list[str]:
    """Reasons for exit status 1 of a library over two sizes, in words; empty where it
    serves.

    Args:
        pillars: the library.
    """
    failures = []
    unknown = 1 - float(pillars.usable.mean())
    if unknown > MOST_UNKNOWN:
        failures.append(
            f"error bars of {unknown:.0%} of the pairs of sizes are above the tolerance {pillars.sweep.bar:g} "
            f"(median {np.median(pillars.t_error):.2g}): allow a larger tolerance or take narrower ranges"
        )
    if pillars.missed:
        failures.append(
            f"{pillars.missed} of {len(pillars.held_out)} pairs held out lie above their error bar"
        )
    return failures


def _two_size_values(pillars: axes.AxesLibrary, seconds: float) -> dict[str, Any]:
    """Result of a sweep over two sizes as a dictionary for JSON."""
    return {
        "engine": "rcwa",
        "entries": pillars.t_error.size,
        "solves": pillars.solves,
        "harmonics": pillars.harmonics,
        "seconds": seconds,
        "usable": float(pillars.usable.mean()),
        "max_error": float(pillars.t_error.max()),
        "median_error": float(np.median(pillars.t_error)),
        "held_out": len(pillars.held_out),
        "held_out_median_error": float(np.median(pillars.held_out[:, 3])),
        "held_out_max_error": float(pillars.held_out[:, 3].max()),
        "held_out_above_bar": pillars.missed,
    }
