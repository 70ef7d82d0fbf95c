"""Design-rule check of the drawn polygons, exact, from the classes of neighbouring
pillars.

Five million pillars have some ten thousand kinds of neighbouring pairs. Count the pairs
of each kind, and measure
each kind once, polygon to polygon.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from layout.mask import Lattice, MaskPlan
from layout.process import Rules
from layout.rules import loops as drc_loops
from layout.rules.figures import figures_kept, frame_kept
from layout.rules.outlines import Outlines
from layout.rules.report import DrcReport, Violation
from layout.rules.zones import in_zones, structures_apart
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

_SHOWN = 500  # violations of one rule that are listed with their place
_BLOCK_SITES = 1 << 21
_MOST_KINDS = 1500


def check(plan: MaskPlan, rules: Rules, *, foot_nm: Array | None = None) -> DrcReport:
    """Check gap, overlap, feature, grid, density and exclusion zones of all pillars and
    figures as they are drawn.

    With a negative tone the gaps and features are those of what stays; what is drawn is
    held to the same limits.

    Args:
        foot_nm: (classes,) diameter of each class at its foot, as it comes out of the
            etch: the gaps there are
            checked too.

    Accuracy:
        exact for gap, overlap, feature and grid; density in windows that step by half
        their size.
    """
    report = DrcReport.empty(plan, rules)
    _off_grid(plan, report)
    if plan.standing is not None:
        frame_kept(plan, rules, report)
        plan = plan.standing  # gaps and features are those of what stays
    shapes = Outlines.of(plan.classes)
    for lattice in plan.lattices:
        counts, density = _count(plan, lattice, rules, report)
        _features(plan, lattice, rules, (shapes, counts), report)
        _gaps(plan, lattice, rules, (shapes, counts), report, foot_nm)
        report.maximum_density = max(report.maximum_density, density)
    figures_kept(plan, rules, report)
    in_zones(plan, rules, report, _SHOWN)
    structures_apart(plan, rules, report)
    return report


def _count(
    plan: MaskPlan, lattice: Lattice, rules: Rules, report: DrcReport
) -> tuple[Array, float]:
    """Pillars of each class, and the largest density of any window; dense windows are
    reported.
    """
    window = rules.density_window_um * 1e3 / plan.unit_nm / 2
    side, down = (
        max(1, round(window / step)) for step in (lattice.pitch, lattice.down)
    )
    tiles = (math.ceil(lattice.rows / down) + 1, math.ceil(lattice.columns / side) + 1)
    area = np.array([0.0, *(made.twice_area / 2 for made in plan.classes)])
    counts, cover = np.zeros(len(area), np.int64), np.zeros(tiles)
    for first, block in lattice.blocks(max(1, _BLOCK_SITES // lattice.columns)):
        drc_loops.count_and_cover(block, first, area, (down, side), counts, cover)
    report.pillars += int(counts[1:].sum())
    windows = cover[:-1, :-1] + cover[1:, :-1] + cover[:-1, 1:] + cover[1:, 1:]
    wide, high = 2 * side * lattice.pitch, 2 * down * lattice.down
    share = windows / (float(wide) * high)
    for i, j in np.argwhere(share > rules.maximum_density):
        x, y = (
            lattice.x0 + j * side * lattice.pitch,
            lattice.y0 - i * down * lattice.down,
        )
        box = (int(x), int(y) - high, int(x) + wide, int(y))
        report.add(
            "density",
            1,
            Violation(
                "density", box, float(share[i, j]), rules.maximum_density, lattice.name
            ),
        )
    return counts, float(share.max(initial=0.0))


def _features(
    plan: MaskPlan,
    lattice: Lattice,
    rules: Rules,
    found: tuple[Outlines, Array],
    report: DrcReport,
) -> None:
    """Widths of the pillars, and the spaces between edges of one pillar: its hole, its
    hollows.
    """
    shapes, counts = found
    used = np.flatnonzero(counts[1:]) + 1
    of = shapes.kind[used] - 1
    widths, spaces = shapes.widths[of] * plan.unit_nm, shapes.spaces[of] * plan.unit_nm
    report.minimum_feature_nm = min(
        report.minimum_feature_nm, float(widths.min(initial=math.inf))
    )
    report.minimum_gap_nm = min(
        report.minimum_gap_nm, float(spaces.min(initial=math.inf))
    )
    for rule, value, limit in (
        ("feature", widths, rules.minimum_feature_nm),
        ("gap", spaces, rules.minimum_gap_nm),
    ):
        bad = dict(
            zip(
                used[value < limit - 1e-9].tolist(),
                value[value < limit - 1e-9].tolist(),
                strict=True,
            )
        )
        for k in bad:
            report.add(rule, int(counts[k]), None)
        for x, y, k in itertools.islice(_sites_of(lattice, list(bad)), _SHOWN):
            box = _box(plan.classes[k - 1].outline, x, y)
            report.add(
                rule, 0, Violation(rule, box, bad[k], limit, plan.classes[k - 1].name)
            )


def _sites_of(lattice: Lattice, classes: list[int]) -> Iterator[tuple[int, int, int]]:
    """(x, y, class) of all sites of these classes."""
    if not classes:
        return
    for first, block in lattice.blocks(max(1, _BLOCK_SITES // lattice.columns)):
        for row, column in np.argwhere(np.isin(block, classes)).tolist():
            yield *_place(lattice, first + row, column), int(block[row, column])


def _gaps(
    plan: MaskPlan,
    lattice: Lattice,
    rules: Rules,
    found: tuple[Outlines, Array],
    report: DrcReport,
    foot_nm: Array | None,
) -> None:
    """Measure each kind of pair that can be closer than the rule, or closer than all
    others.
    """
    shapes, counts = found
    kinds = np.unique(shapes.kind[1:][counts[1:] > 0])
    if not len(kinds):
        return
    if len(kinds) > _MOST_KINDS:
        raise ProcessError(
            f"{len(kinds)} different outlines, the check takes {_MOST_KINDS}; raise diameter_step_nm"
        )
    narrow = np.zeros(len(shapes.contours) + 1, np.int64)
    narrow[kinds] = np.arange(1, len(kinds) + 1)
    kind = narrow[shapes.kind]
    widest = float(shapes.reach[kinds].max())
    limit = rules.minimum_gap_nm / plan.unit_nm
    foot = np.zeros(len(kinds) + 1)
    if foot_nm is not None:
        np.maximum.at(foot, kind[1:][counts[1:] > 0], foot_nm[counts[1:] > 0])
    reach = max(
        2 * widest + limit, (foot.max() + rules.minimum_foot_gap_nm) / plan.unit_nm
    )
    offsets = _offsets(lattice, reach)
    steps = np.array([lattice.pitch, lattice.down])
    table = np.zeros((len(offsets), len(kinds) + 1, len(kinds) + 1), np.int64)
    for block, new, _ in _with_rows_above(lattice, int(offsets[:, 1].max())):
        drc_loops.pair_histogram(block, new, kind, offsets, table)
    bad, least = _measure(table, offsets * steps, (shapes, kinds), limit)
    least = min(least, float(shapes.spaces[kinds - 1].min()))
    report.minimum_gap_nm = min(report.minimum_gap_nm, least * plan.unit_nm)
    if bad:
        _report_gaps(plan, lattice, (kind, offsets, table), bad, report)
    if foot_nm is not None:
        _all_feet(
            plan,
            lattice,
            rules,
            (offsets * steps, table, foot),
            (foot_nm, counts, least),
            report,
        )


def _all_feet(
    plan: MaskPlan,
    lattice: Lattice,
    rules: Rules,
    pairs: tuple[Array, Array, Array],
    found: tuple[Array, Array, float],
    report: DrcReport,
) -> None:
    """Gaps between feet; of pillars that are not round by the least gap drawn, less
    what the widest wall leans out.
    """
    foot_nm, counts, least = found
    used = [
        k for k, made in enumerate(plan.classes) if counts[k + 1] and not made.round
    ]
    if not used:
        _feet(lattice, rules, pairs, report)
        return
    apart = least * plan.unit_nm - max(
        float(foot_nm[k]) - plan.classes[k].diameter_nm for k in used
    )
    _feet_found(
        lattice, rules, apart, int(apart < rules.minimum_foot_gap_nm - 1e-9), report
    )


def _feet(
    lattice: Lattice, rules: Rules, pairs: tuple[Array, Array, Array], report: DrcReport
) -> None:
    """Gaps between round feet, for each kind of pair; one violation is listed for each
    lattice.
    """
    moves, table, foot = pairs
    m, a, b = np.nonzero(table)
    standing = (a > 0) & (b > 0)
    m, a, b = m[standing], a[standing], b[standing]
    gaps = np.hypot(*moves[m].T) * report.unit_nm - (foot[a] + foot[b]) / 2
    least = float(gaps.min(initial=math.inf))
    bad = gaps < rules.minimum_foot_gap_nm - 1e-9
    _feet_found(lattice, rules, least, int(table[m[bad], a[bad], b[bad]].sum()), report)


def _feet_found(
    lattice: Lattice, rules: Rules, least: float, pairs: int, report: DrcReport
) -> None:
    """Enter the least gap between feet, and how many pairs are nearer than the rule."""
    report.minimum_foot_gap_nm = min(report.minimum_foot_gap_nm, least)
    if pairs:
        box = (
            lattice.x0,
            lattice.y0 - lattice.rows * lattice.down,
            lattice.x0 + lattice.columns * lattice.pitch,
        )
        text = f"feet of etched pillars in {lattice.name}"
        report.add("foot", pairs, None)
        report.add(
            "foot",
            0,
            Violation(
                "foot", (*box, lattice.y0), least, rules.minimum_foot_gap_nm, text
            ),
        )


def _offsets(lattice: Lattice, reach: float) -> Array:
    """(m, 2) lattice steps (right, up) to all neighbours within ``reach``, one of each
    opposite pair; the nearest
    sites on all sides in any case (of a centred lattice two columns off, too).
    """
    pitch, down, beside = lattice.pitch, lattice.down, 2 if lattice.centred else 1
    across, up = max(beside, int(reach // pitch)), max(1, int(reach // down))
    steps = [
        (i, j)
        for j in range(up + 1)
        for i in range(-across, across + 1)
        if (j > 0 or i > 0)
        and ((abs(i) <= beside and j <= 1) or math.hypot(i * pitch, j * down) < reach)
    ]
    return np.array(steps)


def _with_rows_above(lattice: Lattice, above: int) -> Iterator[tuple[Array, int, int]]:
    """(block with up to ``above`` rows of the block before it, number of those rows,
    row number of its first).
    """
    kept = None
    for first, block in lattice.blocks(max(above, _BLOCK_SITES // lattice.columns, 1)):
        whole = block if kept is None else np.concatenate([kept, block])
        new = len(whole) - len(block)
        yield whole, new, first - new
        kept = whole[-above:].copy()


def _measure(
    table: Array, moves: Array, drawn: tuple[Outlines, Array], limit: float
) -> tuple[dict[tuple[int, int, int], float], float]:
    """{(offset, kind, kind): gap} below the limit, and the least gap of all, in
    database units.
    """
    shapes, kinds = drawn
    reach = np.array([0.0, *shapes.reach[kinds]])
    m, a, b = np.nonzero(table)
    standing = (a > 0) & (b > 0)
    m, a, b = m[standing], a[standing], b[standing]
    least_possible = np.hypot(*moves[m].T) - reach[a] - reach[b]
    bad: dict[tuple[int, int, int], float] = {}
    least = math.inf
    for i in np.argsort(least_possible, kind="stable"):
        if least_possible[i] >= max(limit, least):
            break
        key = int(m[i]), int(a[i]), int(b[i])
        one, two = (int(kinds[n - 1]) - 1 for n in key[1:])
        gap = shapes.gap(one, two, int(moves[m[i], 0]), int(moves[m[i], 1]))
        least = min(least, gap)
        if gap < limit - 1e-9:
            bad[key] = gap
    return bad, least


def _report_gaps(
    plan: MaskPlan,
    lattice: Lattice,
    pairs: tuple[Array, Array, Array],
    bad: dict[tuple[int, int, int], float],
    report: DrcReport,
) -> None:
    kind, offsets, table = pairs
    marked = np.zeros(table.shape, bool)
    for key, gap in bad.items():
        marked[key] = True
        report.add("overlap" if gap <= 0 else "gap", int(table[key]), None)
    found = np.empty((_SHOWN, 3), np.int64)
    for block, new, first in _with_rows_above(lattice, int(offsets[:, 1].max())):
        count = drc_loops.find_pairs(block, new, kind, offsets, marked, found, 0)
        for row, column, m in found[:count].tolist():
            right, up = offsets[m].tolist()
            one, two = int(block[row, column]), int(block[row - up, column + right])
            gap = bad[m, int(kind[one]), int(kind[two])] * plan.unit_nm
            here = _box(
                plan.classes[one - 1].outline, *_place(lattice, first + row, column)
            )
            there = _box(
                plan.classes[two - 1].outline,
                *_place(lattice, first + row - up, column + right),
            )
            box = (
                min(here[0], there[0]),
                min(here[1], there[1]),
                max(here[2], there[2]),
                max(here[3], there[3]),
            )
            text = f"{plan.classes[one - 1].name} to {plan.classes[two - 1].name} in {lattice.name}"
            rule = "overlap" if gap <= 0 else "gap"
            report.add(
                rule,
                0,
                Violation(
                    rule, box, max(gap, 0.0), plan.unit_nm * report.limit_gap, text
                ),
            )
        if sum(v.rule in ("gap", "overlap") for v in report.violations) >= _SHOWN:
            return


def _off_grid(plan: MaskPlan, report: DrcReport) -> None:
    grid = plan.grid
    for made in plan.classes:
        for shape in made.polygons:
            if (np.asarray(shape) % grid).any():
                report.add(
                    "off-grid",
                    1,
                    Violation(
                        "off-grid", _box(shape, 0, 0), 0.0, float(grid), made.name
                    ),
                )
    for lattice in plan.lattices:
        if (
            lattice.pitch % grid
            or lattice.down % grid
            or lattice.x0 % grid
            or lattice.y0 % grid
        ):
            box = (lattice.x0, lattice.y0, lattice.x0, lattice.y0)
            report.add(
                "off-grid",
                1,
                Violation("off-grid", box, 0.0, float(grid), lattice.name),
            )
    for figure in plan.figures:
        for shape in itertools.chain.from_iterable(figure.polygons.values()):
            if (np.asarray(shape) % grid).any():
                report.add(
                    "off-grid",
                    1,
                    Violation(
                        "off-grid", _box(shape, 0, 0), 0.0, float(grid), figure.name
                    ),
                )


def _place(lattice: Lattice, row: int, column: int) -> tuple[int, int]:
    return lattice.x0 + column * lattice.pitch, lattice.y0 - row * lattice.down


def _box(outline: Array, x: int, y: int) -> tuple[int, int, int, int]:
    low, high = outline.min(0), outline.max(0)
    return x + int(low[0]), y + int(low[1]), x + int(high[0]), y + int(high[1])
