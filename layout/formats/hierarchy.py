"""How often each cell of a mask is drawn, by products from the top down: no hierarchy
is taken apart.
"""

import graphlib
from collections import Counter

from layout.formats.content import MaskContent
from layout.process import LayerNumber
from metalens.core.errors import MaskFileError


def topological_order(content: MaskContent) -> list[str]:
    """All cells, each after those that place it.

    Raises:
        MaskFileError: a cell that places itself, or one that is placed and not there.
    """
    above: dict[str, list[str]] = {name: [] for name in content.cells}
    for name, cell in content.cells.items():
        for child in cell.placed.children:
            if child not in above:
                raise MaskFileError(
                    f"cell {child!r} is placed, but the file does not hold it"
                )
            above[child].append(name)
    try:
        return list(graphlib.TopologicalSorter(above).static_order())
    except graphlib.CycleError as error:
        name, *others = error.args[1]
        raise MaskFileError(
            f"cell {name!r} places itself through {' > '.join(others[:9])}; the file is no mask"
        ) from None


def drawn_counts(content: MaskContent) -> dict[str, int]:
    """{cell: how often it is drawn below the top cells}, each after those that place
    it; 1 for a top cell.

    Raises:
        MaskFileError: as :func:`topological_order`.
    """
    times = dict.fromkeys(topological_order(content), 0)
    times |= dict.fromkeys(content.tops, 1)
    for name in times:
        cell = content.cells[name]
        for child, count in zip(
            cell.placed.children, cell.counts().tolist(), strict=True
        ):
            times[child] += times[name] * count
    return times


def count_shapes(content: MaskContent) -> Counter[LayerNumber]:
    """Shapes that the top cells draw on each layer.

    Raises:
        MaskFileError: as :func:`topological_order`.
    """
    found: Counter[LayerNumber] = Counter()
    for name, times in drawn_counts(content).items():
        cell = content.cells[name]
        for some in (cell.polygons, cell.circles):
            found.update({layer: times * len(held) for layer, held in some.items()})
    return found


def refuse_beyond(content: MaskContent, most: int) -> None:
    """Count what the hierarchy would draw when taken apart.

    Raises:
        MaskFileError: more than ``most`` shapes (copies of a cell that holds nothing
            count as one), with the number; as
            :func:`topological_order`.
    """
    total = sum(
        times * content.cells[name].taken
        for name, times in drawn_counts(content).items()
    )
    if total > most:
        raise MaskFileError(
            f"the mask draws {total:,} shapes when its arrays are taken apart, at most {most:,} are taken "
            "(metalens check --max-shapes sets another limit, at 25 to 150 bytes of memory for each)"
        )
