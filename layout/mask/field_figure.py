"""Borders of the write fields as a figure of the mask."""

import itertools

import numpy as np

from layout.mask.fields import FieldPlan
from layout.mask.plan import FigureCell, MaskPlan
from layout.process.process import Process


def with_fields(plan: MaskPlan, split: FieldPlan, process: Process) -> MaskPlan:
    """The plan with one rectangle for each write field, clipped to the lens.

    Args:
        plan: with the lens as its first lattice.
        split: write fields of the lens.
        process: layers.
    """
    lattice = plan.lattices[0]

    def borders(sites: np.ndarray, last_site: int, step: int) -> list[int]:
        return [
            int(site) * step - step // 2
            for site in np.unique(np.clip(sites, 0, last_site))
        ]

    xs = [
        lattice.x0 + border
        for border in borders(split.columns, lattice.columns, lattice.pitch)
    ]
    first_row = lattice.y0 - (lattice.rows - 1) * lattice.down
    ys = [
        first_row + border for border in borders(split.rows, lattice.rows, lattice.down)
    ]
    boxes = tuple(
        np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        // plan.grid
        * plan.grid
        for (left, right), (bottom, top) in itertools.product(
            itertools.pairwise(xs), itertools.pairwise(ys)
        )
    )
    layer = process.layers.fields
    figure = FigureCell("FIELDS", {layer: boxes})
    return plan.replace(
        figures=(*plan.figures, figure),
        layer_names={**plan.layer_names, layer: "fields"},
    )
