"""CELL.toml to library.h5: pillar sweep with an error bar on every entry, its proxy,
and a figure beside it.
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
from metalens.cell import (
    Cell,
    DiffractionOrder,
    named_orders,
    no_resonance_um,
    substrate_orders,
)
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

LEAST_USABLE = 0.5  # least share of usable pairs of sizes in a library
NM = 1e3
MOST_UNKNOWN = 0.5  # share of the entries whose bars may be above any tolerance


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
    fitted, refusal = _fit(pillars, settings.proxy)
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
    _draw(path, pillars, fitted)
    failures = _failures(
        pillars,
        fitted,
        refusal,
        stated=settings.sweep.tolerance is not None,
        accept_partial_turn=options.accept_partial_turn,
    )
    values = _values(pillars, fitted, seconds)
    text = _text(options.output, pillars, fitted, seconds, failures)
    return options.console.judged(values, text, failures)


def _inputs(path: Path, cell: Cell) -> dict[str, str]:
    """Hashes of the config and of the material tables that the cell names."""
    return {
        file.name: store.sha256(file) for file in (path, *workers.material_files(cell))
    }


def _fit(
    pillars: PillarLibrary, tolerances: ProxyTolerances
) -> tuple[ProxyFit | None, str]:
    """The fitted proxy and "", or None and why there is none."""
    try:
        return proxy_fit.fit(pillars, tolerances), ""
    except DomainError as refused:
        return None, str(refused)


def _draw(target: Path, pillars: PillarLibrary, fitted: ProxyFit | None) -> None:
    from metalens.library import library_figure

    library_figure(target.with_suffix(".png"), pillars, fitted)


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
    if _orders(pillars):
        lost = pillars.lost
        values["lost"] = {"mean": float(lost.mean()), "most": float(lost.max())}
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
            "notes": list(fitted.notes),
            "error_against_coefficients": [
                dataclasses.asdict(trial) for trial in fitted.table
            ],
        }
    return values


def _text(
    target: Path,
    pillars: PillarLibrary,
    fitted: ProxyFit | None,
    seconds: float,
    failures: list[str],
) -> str:
    """Result of a sweep in words: effort, time and error of sweep and proxy.

    Args:
        target: output file.
        pillars: the library.
        fitted: its proxy; None where none fits.
        seconds: time of the sweep.
        failures: reasons for exit status 1.
    """
    each = 1e3 * seconds / max(1, pillars.solves)
    effort = (
        f"  sweep    {pillars.solves:4d} solves ({pillars.engine}, {each:.0f} ms each)   {seconds:6.1f} s    "
        if pillars.engine != "table"
        else "  table                                                 "
    )
    lines = [
        f"{target}: {pillars.t.size} entries, {len(pillars.resonances)} poles near the real diameters",
        *(f"  {note}" for note in pillars.notes if pillars.engine == "table"),
        "",
        "  what     effort                          time        error",
        f"{effort}t within {pillars.t_error.max():.1e} (median {np.median(pillars.t_error):.1e})",
    ]
    if fitted is not None:
        lines += [
            *(
                f"  proxy    {trial.coefficients:4d} coefficients                            "
                f"phase {trial.phase_error_rad:.1e} rad, |T| {trial.transmission_error:.1e}"
                for trial in fitted.table
            ),
            "",
            *_proxy_lines(fitted),
        ]
    if not (
        pillars.converged
        or any(failure.startswith(_above(pillars)) for failure in failures)
    ):
        lines.append(
            f"  {_above(pillars)}, which the file does not state: beside resonances as a rule, "
            "of narrow walls and shapes without mirrors in more places"
        )
    lines += _lost_lines(pillars)
    if pillars.turned is not None:
        lines += _turned_lines(pillars.turned)
    elif pillars.polarization == ("x",) and not pillars.cell.alike:
        lines.append(
            "  all of it for light along x: these pillars answer light along y otherwise"
        )
        lines += _cross_polarised_lines(pillars)
    return "\n".join(lines)


def _orders(pillars: PillarLibrary) -> tuple[DiffractionOrder, ...]:
    """Orders of the substrate, at the shortest wavelength and the widest angle."""
    return substrate_orders(
        pillars.cell,
        float(pillars.wavelength_um[0]),
        angle_rad=float(pillars.angle_rad[-1]),
    )


def _lost_lines(pillars: PillarLibrary) -> list[str]:
    """Light lost to orders of the substrate, in words; empty where none propagates."""
    orders, lost = _orders(pillars), pillars.lost
    if not orders:
        return []
    return [
        f"  diffraction orders {named_orders(orders)} propagate in the substrate: with "
        f"absorption they take {lost.mean():.1%} of the light in the mean, "
        f"{lost.max():.1%} at most"
    ]


def _cross_polarised_lines(pillars: PillarLibrary) -> list[str]:
    """Share of light along x that leaves along y, in words.

    It is not 0 only where no mirror of the shape lies along x or y.
    """
    outline = pillars.cell.outline(float(pillars.diameter_um[-1]))
    if outline.keeps(-1, 1) or outline.keeps(1, -1):
        return []
    lost = float(1 - pillars.energy.min())
    return [
        f"  up to {lost:.0%} of it leaves along y, or is absorbed: no mirror of the shape lies along x or y; turn it "
        "(angle_rad) until one does"
    ]


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


def _turned_lines(turned: GeometricPhase) -> list[str]:
    """Conversion of circular light by the rotated pillar, in words."""
    shares = _circular(turned)
    return [
        f"  turned in its lattice, {1e3 * turned.size_um:.1f} nm: {shares['converted']:.3f} +- "
        f"{shares['converted_error']:.2g} of circular light is converted with the geometric phase, "
        f"{shares['unconverted']:.2g} +- {shares['unconverted_error']:.1g} keeps its hand",
        f"  a pillar turned alone is {shares['isolated_error']:.2g} of t off the solved ones at "
        f"{len(turned.angle_rad)} turns (solver within {shares['solver_error']:.1g})",
    ]


def _proxy_lines(fitted: ProxyFit) -> list[str]:
    """Domain, coverage and errors of the proxy, in words."""
    proxy = fitted.proxy
    low, high = (1e3 * d for d in proxy.domain_um)
    turns = "" if math.isnan(fitted.turns) else f", {fitted.turns:.2f} turns"
    lines = [
        f"  proxy in diameter^{proxy.power} from {low:.1f} to {high:.1f} nm{turns}: phase within "
        f"{proxy.max_phase_error_rad:.1e} rad, |T| within {proxy.max_transmission_error:.1e} (half of them unseen),",
        f"  of entries whose own error bars are {proxy.entry_error:.1e} of |t| (root mean square)",
    ]
    if fitted.polarization_spread > 0:
        lines.append(
            f"  s and p differ by up to {2 * fitted.polarization_spread:.1e}; the proxy holds their mean"
        )
    return lines + [f"  {note}" for note in fitted.notes]


def _run_two_sizes(options: Options, settings: CellFile) -> int:
    """Sweep over two sizes, write and draw the library.

    Exit status 1 where most error bars miss the tolerance, or a held-out pair lies
    above its bar.
    """
    from metalens.library import plots

    target = options.output
    inputs = _inputs(options.config, settings.cell)
    with options.claim(target, companions=(".png",)) as draft, options.shared():
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
        axes.save(draft.path, pillars)
        plots.axes_library_figure(draft.path.with_suffix(".png"), pillars)
    return options.console.judged(
        _two_size_values(pillars, seconds),
        _two_size_text(target, pillars, seconds),
        two_size_failures(pillars),
    )


def two_size_failures(pillars: axes.AxesLibrary) -> list[str]:
    """Reasons for exit status 1 of a library over two sizes, in words; empty where it
    serves.

    Args:
        pillars: the library.
    """
    failures = []
    share = float(pillars.usable.mean())
    if share < LEAST_USABLE:
        failures.append(
            f"error bars of {1 - share:.0%} of the pairs of sizes are above the tolerance {pillars.sweep.bar:g} "
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
        "least_transmission": [float(v) for v in _least(pillars)],
    }


def _least(pillars: axes.AxesLibrary) -> list[float]:
    """Least |t| of both polarisations among the usable pairs; 0 where there is none."""
    return [
        float(np.abs(pillars.t[..., k, k])[pillars.usable].min(initial=1.0))
        for k in (0, 1)
    ]


def _two_size_text(target: Path, pillars: axes.AxesLibrary, seconds: float) -> str:
    """Result of a sweep over two sizes in words: sizes, effort, errors, held-out
    pairs.
    """
    x, y, held_out = NM * pillars.x_um, NM * pillars.y_um, pillars.held_out
    lines = [
        f"{target}: {len(x)} x {len(y)} sizes ({x[0]:.1f}-{x[-1]:.1f} nm along x, {y[0]:.1f}-{y[-1]:.1f} nm along y), "
        f"Jones matrices at {len(pillars.wavelength_um)} wavelength(s)",
        f"  {pillars.solves} solves (rcwa, orders within {pillars.harmonics}), {seconds:.1f} s",
        f"  t within {np.median(pillars.t_error):.1e} in the median; {pillars.usable.mean():.1%} of the sizes are within "
        f"{pillars.sweep.bar:g}, the others are excluded bands of resonances",
        f"  {len(held_out)} pairs held out: interpolated within {np.median(held_out[:, 3]):.1e} in the median, "
        f"{held_out[:, 3].max():.1e} at most, {pillars.missed} above their bar",
    ]
    return "\n".join(lines)
