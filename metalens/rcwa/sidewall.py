"""Tilted walls as staircases of upright sections."""

import math
from dataclasses import replace

from metalens.cell import Cell, Layer


def width_slope(cell: Cell) -> float:
    """Change of width for each um of height of a ``cell`` with tilted walls."""
    return -2 * math.tan(cell.sidewall_rad)


def sections_with_growth(cell: Cell) -> list[tuple[Layer, float]]:
    """Sections of a ``cell``, foot first, with the widening at the middle of each by
    the tilted wall, um.
    """
    sections, foot = [], -cell.height_um / 2
    for layer in cell.sections:
        sections.append((layer, width_slope(cell) * (foot + layer.height_um / 2)))
        foot += layer.height_um
    return sections


def staircase_layers(cell: Cell, steps: int) -> list[Layer]:
    """Staircase approximation: the sections of a ``cell``, each of a tilted wall cut
    into ``steps`` upright ones of equal height.
    """
    count = steps if cell.sidewall_rad else 1
    layers = []
    for layer, grow in sections_with_growth(cell):
        step_um = layer.height_um / count
        for i in range(count):
            step_growth = (i + 0.5 - count / 2) * step_um * width_slope(cell)
            width = layer.grow_um + grow + step_growth
            layers.append(replace(layer, height_um=step_um, grow_um=width))
    return layers
