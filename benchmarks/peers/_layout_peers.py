"""gdstk and KLayout at their best on the pillars of the mask bench, and their agreement
with our files.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np

import layout
from benchmarks import Row, fastest
from benchmarks.speed.layout import NAN, PITCH, RULES, lens_of, plan
from layout.drc.lattice import check_plan
from layout.mask.plan import MaskPlan, PillarArray


def measured(target: Path) -> list[Row]:
    """All rows; files are written to ``target``."""
    return [*_gdstk_rows(target), *_klayout_rows(target)]


def gdstk_library(mask: MaskPlan) -> Any:
    """The pillars of the bench in gdstk: a list of offsets for each diameter."""
    import gdstk

    grid, size = mask.lattices[0].whole(), PITCH * 1e-3
    library = gdstk.Library("TOP", unit=1e-6, precision=1e-9)
    top = library.new_cell("TOP")
    for k, made in enumerate(mask.classes, 1):
        cell = library.new_cell(made.name)
        cell.add(gdstk.Polygon(made.outline * 1e-3, layer=1))
        row, column = np.nonzero(grid == k)
        place = np.column_stack([(column - 1250) * size, (1250 - row) * size])
        reference = gdstk.Reference(cell, tuple(place[0]))
        reference.repetition = gdstk.Repetition(offsets=(place - place[0])[1:])
        top.add(reference)
    return library


def klayout_layout(mask: MaskPlan) -> Any:
    """The pillars of the bench in KLayout: an instance for each."""
    import klayout.db as db

    grid = mask.lattices[0].whole()
    made = db.Layout()
    made.dbu = 0.001
    top, layer = made.create_cell("TOP"), made.layer(1, 0)
    cells = []
    for kind in mask.classes:
        cell = made.create_cell(kind.name)
        cell.shapes(layer).insert(
            db.Polygon([db.Point(*p) for p in kind.outline.tolist()])
        )
        cells.append(cell.cell_index())
    rows, columns = np.nonzero(grid)
    x = ((columns - 1250) * PITCH).tolist()
    y = ((1250 - rows) * PITCH).tolist()
    for k, px, py in zip(grid[rows, columns].tolist(), x, y, strict=True):
        top.insert(db.CellInstArray(cells[k - 1], db.Vector(px, py)))
    return made


def _gdstk_rows(target: Path) -> list[Row]:
    try:
        import gdstk
    except ImportError:
        return []
    mask = plan()
    grid = mask.lattices[0].whole()

    made = []
    for name, write in (
        ("GDSII", lambda: gdstk_library(mask).write_gds(target / "g.gds")),
        (
            "OASIS level 6",
            lambda: gdstk_library(mask).write_oas(
                target / "g.oas", compression_level=6
            ),
        ),
    ):
        seconds = fastest(write, repeats=1)
        size = (target / ("g.gds" if name == "GDSII" else "g.oas")).stat().st_size / 1e6
        made.append(
            Row(
                "free-form",
                f"gdstk build + write {name}",
                seconds,
                NAN,
                f"{size:.2f} MB, no comparison",
            )
        )
    layout.write_oasis(mask, target / "r.oas")
    start = time.perf_counter()
    library = gdstk.read_oas(target / "r.oas")
    seconds = time.perf_counter() - start
    lens = next(cell for cell in library.cells if cell.name == "LENS")
    count = len(lens.references)
    wrong = float(count - np.count_nonzero(grid))
    valid, _ = gdstk.oas_validate(target / "r.oas")
    text = f"pillars less the plan; checksum {'right' if valid else 'WRONG'}"
    return [
        *made,
        Row(
            "free-form",
            "gdstk opens OASIS reader",
            seconds,
            wrong,
            text,
            goal="<= 0.5 s",
        ),
    ]


def _klayout_rows(target: Path) -> list[Row]:
    try:
        import klayout.db as db
    except ImportError:
        return []
    mask = plan()
    grid = mask.lattices[0].whole()

    start = time.perf_counter()
    klayout_layout(mask).write(str(target / "k.gds"))
    made = [
        Row(
            "free-form",
            "KLayout build + write GDSII",
            time.perf_counter() - start,
            NAN,
            "no comparison",
        )
    ]
    for name, write in (("m.gds", layout.write_gdsii), ("m.oas", layout.write_oasis)):
        write(mask, target / name)
        start = time.perf_counter()
        read = db.Layout()
        read.read(str(target / name))
        seconds = time.perf_counter() - start
        count = db.Region(read.cell("TOP").begin_shapes_rec(read.layer(1, 0))).count()
        wrong = float(count - np.count_nonzero(grid))
        made.append(
            Row(
                "free-form",
                f"KLayout reads {name[2:]}",
                seconds,
                wrong,
                "pillars less the plan",
            )
        )
    return [*made, _klayout_check(db, mask)]


def _klayout_check(db: object, mask: MaskPlan) -> Row:
    """The space check of KLayout on a patch of 240 000 pillars."""
    patch = mask.lattices[0].whole()[1005:1495, 1005:1495]
    region = db.Region()  # type: ignore[attr-defined]
    shapes = [
        db.Polygon([db.Point(*p) for p in kind.outline.tolist()])
        for kind in mask.classes
    ]  # type: ignore[attr-defined]
    for row, column in np.argwhere(patch > 0).tolist():
        region.insert(
            shapes[patch[row, column] - 1].moved(column * PITCH, -row * PITCH)
        )
    region.merged_semantics = False
    start = time.perf_counter()
    count = region.space_check(70, False, db.Region.Euclidian).count()  # type: ignore[attr-defined]
    thin = region.width_check(80, False, db.Region.Projection).count()  # type: ignore[attr-defined]
    overlap = region.merged(False, 2).count()
    seconds = time.perf_counter() - start
    plan_of_patch = lens_of(
        PillarArray.of("LENS", patch.copy(), pitch=PITCH, x0=0, y0=0)
    )
    own = check_plan(plan_of_patch, RULES).counts
    wrong = (
        abs(count - own["space"])
        + abs(min(thin, 1) - min(own["width"], 1))
        + abs(overlap - own["overlap"])
    )
    whole = fastest(lambda: check_plan(mask, RULES))
    ratio = seconds / patch.size / (whole / np.count_nonzero(mask.lattices[0].whole()))
    return Row(
        "240 100 pillars",
        "KLayout gap, width and overlap checks",
        seconds,
        float(wrong),
        "violations, ours less theirs",
        goal=f"ours, all checks, is {ratio:.0f}x faster a pillar (500x)",
    )
