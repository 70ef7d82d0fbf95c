"""Design rules of any mask file (GDSII or OASIS): ``metalens check``."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from layout.drc.klayout import write_lyrdb
from layout.drc.library import LayerChoice, Metric, check_library
from layout.drc.report import DrcReport, format_size
from layout.formats.files import placement_limit
from layout.formats.library import MaskLibrary
from layout.formats.reading import read_mask
from layout.process import process as processes
from metalens.commands import CommonOptions, MaybeOutput
from metalens.core.errors import MaskFileError


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens check``.

    Attributes:
        mask: GDSII or OASIS file, distinguished by its first bytes.
        process: PROCESS.toml with the rules; omitted: the defaults.
        output: marker database to write (.lyrdb for KLayout); omitted: none.
        layers: layers to check, as 1 (all datatypes together) or 1/0; omitted: every
            layer of the file.
        top: cell to check with all below it; omitted: all top cells.
        metric: of spaces: projection (edges that face each other) or euclidean (also
            from corner to corner).
        max_shapes: shapes and cell references that may be expanded, some 100 bytes of
            memory each; omitted: 4 million, and 20 more for each byte of the file.
    """

    mask: tyro.conf.Positional[Path]
    process: Path | None = None
    output: MaybeOutput = None
    layers: tuple[str, ...] = ()
    top: str | None = None
    metric: Metric = "projection"
    max_shapes: int | None = None


def run(options: Options) -> int:
    """Check the mask; exit 1 where a rule is violated or no shape was checked.

    Args:
        options: of the command.
    """
    layers = [parse_layer(text) for text in options.layers]
    process = processes.load_process(options.process)
    output = (
        options.claim(options.output)
        if options.output is not None
        else contextlib.nullcontext()
    )
    with output as draft:
        content = read_mask(options.mask, options.max_shapes)
        if options.top is not None:
            content = content.below(options.top)
        report = check_library(
            content,
            process.rules,
            layers=layers or None,
            negative=_negative_layers(content, process),
            metric=options.metric,
            max_elements=options.max_shapes or placement_limit(options.mask),
        )
        if draft is not None:
            write_lyrdb(report, content.tops[0], draft.path)
    values = _values(content, report)
    failures = _failures(options, report, layers)
    text = _text(options.mask, content, report)
    return options.console.judged(values, text, failures)


def parse_layer(text: str) -> LayerChoice:
    """Layer number and datatype of "1" (datatype None: all) or "1/0".

    Args:
        text: as a user writes it.

    Raises:
        MaskFileError: neither of these.
    """
    number, slash, datatype = text.partition("/")
    if not number.isdigit() or (slash and not datatype.isdigit()):
        raise MaskFileError(
            f"--layers {text}: need LAYER or LAYER/DATATYPE, as 1 or 1/0"
        )
    return int(number), int(datatype) if slash else None


def _negative_layers(content: MaskLibrary, process: processes.Process) -> set[int]:
    """Layer numbers exposed with a negative tone, whose clear areas remain."""
    if process.tone == "positive":
        return set()
    layers = process.layers
    others = {layers.aperture[0], layers.outline[0], layers.fields[0]}
    return {number for number, _ in content.count_shapes()} - others


def _values(content: MaskLibrary, report: DrcReport) -> dict[str, Any]:
    """Values of the report, for JSON."""
    sizes = {name: size for name, size in report.sizes.items() if "foot" not in name}
    layers = {
        f"{layer}/{datatype}": {"checked": coverage.checked, "shapes": coverage.shapes}
        for (layer, datatype), coverage in (report.layers or {}).items()
    }
    return {
        "ok": report.ok,
        "tops": content.tops,
        "shapes": report.shapes,
        "layers": layers,
        "skipped": dict(content.skipped),
        **sizes,
        "violations": report.counts,
        "worst": report.worst,
    }


def format_counts(counts: Mapping[str, int]) -> str:
    """Numbers of elements by kind, for a person.

    Args:
        counts: {kind: number}.
    """
    return ", ".join(f"{count:,} {kind}" for kind, count in sorted(counts.items()))


def _failures(
    options: Options, report: DrcReport, layers: list[LayerChoice]
) -> list[str]:
    """What keeps the mask from being passed, in words."""
    drawn = report.layers or {}
    missing = [
        text
        for text, (number, datatype) in zip(options.layers, layers, strict=True)
        if not any(
            drawn_number == number and datatype in (None, drawn_datatype)
            for drawn_number, drawn_datatype in drawn
        )
    ]
    failures = [f"nothing is drawn on layer {text}" for text in missing]
    if report.is_empty:
        failures.append("no shape was checked")
    if report.violated:
        failures.append(f"design rules violated: {report.violated}")
    return failures


def _text(path: Path, content: MaskLibrary, report: DrcReport) -> str:
    """The report for a person: verdict, layers, and the first violations."""
    verdict = "keeps" if report.ok else "does not keep"
    space = (
        f"minimum space {format_size(report.minimum_space_nm)}"
        if report.sizes["minimum_space_nm"] is not None
        else f"no space below {report.limits['space']:g} nm"
    )
    width = format_size(report.minimum_width_nm)
    lines = [
        f"{path}: {verdict} the design rules; top cells {', '.join(content.tops[:8])}",
        f"  {report.shapes:,} shapes checked; {space}, minimum width {width}",
    ]
    for (layer, datatype), coverage in (report.layers or {}).items():
        state = "checked" if coverage.checked else "NOT CHECKED"
        lines.append(f"  layer {layer}/{datatype}: {coverage.shapes:,} shapes, {state}")
    if content.skipped:
        lines.append(f"  draw nothing: {format_counts(content.skipped)}")
    lines += [
        f"  {entry['count']:,} {entry['rule']} in {entry['cell']}, "
        f"layer {entry['layer']}: worst {entry['worst']:.4g}, need {entry['limit']:.4g}"
        for entry in report.worst[:20]
    ]
    lines += [
        f"  {violation.rule} at ({violation.centre[0]:.0f}, "
        f"{violation.centre[1]:.0f}): {violation.summary}"
        for violation in report.violations[:10]
    ]
    return "\n".join(lines)
