"""Design rules on a mask made anywhere (GDSII or OASIS): gaps, features, grid;
violations as markers for KLayout.
"""

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from layout.commands.validate import validate
from layout.files import MaskContent, hierarchy, mapped
from layout.gdsii import read as gdsii_read
from layout.oasis import bytes as oasis_bytes
from layout.oasis import read as oasis_read
from layout.process import process as processes
from layout.rules import DrcReport, foreign, markers, told
from metalens.commands import Common, MaybeOutput
from metalens.ground import reading
from metalens.ground.errors import MaskFileError


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens check``.

    Attributes:
        mask: GDSII or OASIS file, told apart by its first bytes.
        process: PROCESS.toml with the rules; left out: the defaults.
        output: marker database to write (.lyrdb for KLayout); left out: none.
        ignore: layer numbers that are not drawn in the resist, besides outline and
            write fields of the process.
        most_shapes: shapes that may be taken apart, some 25 bytes of memory for each
            copy of a cell and 150 for each
            shape that is drawn by itself; a large cell that is placed again and again
            counts once. Left out: 4
            million, and 20 more for each byte of the file.
        strict: also what readers let pass and a mask shop might not: names of cells,
            one top cell, doubled vertices,
            strict tables and the checksum of OASIS.
    """

    mask: tyro.conf.Positional[Path]
    process: Path | None = None
    output: MaybeOutput = None
    ignore: tuple[int, ...] = ()
    most_shapes: int | None = None
    strict: bool = False


def run(options: Options) -> int:
    """Check the mask; exit 1 where a rule is broken."""
    if min(options.ignore, default=0) < 0:
        raise MaskFileError(
            f"--ignore {min(options.ignore)}: need numbers of layers, 0 or more"
        )
    process = (
        processes.Process()
        if options.process is None
        else processes.load(options.process)
    )
    if not options.mask.is_file():
        raise MaskFileError(
            f"{options.mask}: {reading.absent(options.mask)}; need a GDSII or OASIS mask"
        )
    output = (
        options.claim(options.output)
        if options.output is not None
        else contextlib.nullcontext()
    )
    with output as draft:
        most = (
            foreign.most_of(options.mask)
            if options.most_shapes is None
            else options.most_shapes
        )
        content = read(options.mask, most)
        skip = (process.layers.outline[0], process.layers.fields[0], *options.ignore)
        form = validate(options.mask, content) if options.strict else []
        negative, tops = _negative(content, process), content.tops
        found = foreign.check(
            content, process.rules, skip=skip, negative=negative, most=most, last=True
        )
        if draft is not None:
            markers.write_lyrdb(
                markers.Top(tops[0], content.unit_nm), found, draft.path
            )
    values = _values(found) | (
        {"form": [finding.text for finding in form]} if options.strict else {}
    )
    failures = [f"design rules broken: {found.broken}"] if found.broken else []
    failures += [f"form: {finding.text}" for finding in form]
    return options.console.judged(values, _text(options.mask, found), failures)


def _negative(content: MaskContent, process: processes.Process) -> set[int]:
    """Layer numbers whose clear areas stay: with tone ``negative`` all but the openings
    of the aperture.
    """
    if process.tone == "positive":
        return set()
    return {number for number, _ in hierarchy.shapes(content)} - {
        process.layers.aperture[0]
    }


def read(
    path: Path, most: int | None = None, *, keep: int | None = None
) -> MaskContent:
    """A mask of either format; more placements than ``most`` (by default what its size
    allows) are not taken apart.

    keep: most placements of a cell that are kept; of more only their sums. None: all.

    Raises:
        MaskFileError: more than these, or a file that cannot be read.
    """
    if found := reading.foreign(path):
        raise MaskFileError(f"{path}: {found}, need GDSII or OASIS")
    is_oasis = mapped(path)[: len(oasis_bytes.MAGIC)].tobytes() == oasis_bytes.MAGIC
    return (oasis_read.read if is_oasis else gdsii_read.read)(
        path, limit=foreign.most_of(path) if most is None else most, keep=keep
    )


def _values(found: DrcReport) -> dict[str, Any]:
    return {
        "ok": found.ok,
        "shapes": found.pillars,
        **{
            name: size
            for name, size in found.sizes.items()
            if name != "minimum_foot_gap_nm"
        },
        "violations": found.counts,
    }


def _gap(found: DrcReport) -> str:
    """Only gaps that break the rule are all looked at."""
    least = found.minimum_gap_nm
    return (
        f"smallest gap {told(least)}"
        if math.isfinite(least)
        else f"no gap below {found.limits['gap']:g} nm"
    )


def _text(path: Path, found: DrcReport) -> str:
    lines = [
        f"{path}: {'keeps' if found.ok else 'breaks'} the design rules",
        f"  {found.pillars:,} shapes; {_gap(found)}, thinnest {told(found.minimum_feature_nm)}",
    ]
    lines += [
        f"  {v.rule} at ({v.centre[0]:.0f}, {v.centre[1]:.0f}): {v.value:.4g} nm, need {v.limit:.4g}; {v.text}"
        for v in found.violations[:10]
    ]
    return "\n".join(lines)
