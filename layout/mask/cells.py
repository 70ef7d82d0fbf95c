"""Diameter map to pillar classes: equal drawn diameters become one class, a site becomes a class number."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import MOST_CLASSES
from layout.process import Process, isolation
from metalens.ground.arrays import Array
from metalens.ground.errors import LensError, ProcessError
from metalens.ground.units import nm
from metalens.lens import DiameterMap

_FINE = 16  # table entries for one nanometre of designed diameter


@dataclass(frozen=True, eq=False, slots=True)
class Cells:
    """Quantised drawn pillars.

    classes: (y, x) uint8 or uint16, 0 for no pillar. diameters_nm: (k,) whole nm, thinnest first.
    counts: (k,) pillars of each class. rounding_nm: largest difference between wanted and drawn diameter.
    """

    classes: Array
    diameters_nm: Array
    counts: Array
    rounding_nm: float


def quantise(diameters: DiameterMap, process: Process) -> Cells:
    """Drawn diameters (bias taken off) rounded to the diameter step of the process, as classes.

    Raises:
        ProcessError: more than 65 535 classes, a drawn pillar below one step, or one as wide as the pitch
            (row and column named).
        LensError: no pillar at all.
    """
    drawn = drawn_steps(diameters, process)
    counts = np.zeros(int(drawn.max(initial=0)) + 1, np.int64)
    for rows in _row_blocks(drawn):
        counts += np.bincount(drawn[rows].ravel(), minlength=len(counts))
    if counts[1:].sum() == 0:
        raise LensError("empty lens: the map holds no pillar; check the aperture")
    used = np.flatnonzero(counts)
    used = used[used > 0]
    if len(used) > MOST_CLASSES:
        raise ProcessError(f"{len(used)} different diameters, at most {MOST_CLASSES}; raise diameter_step_nm")
    lookup = np.zeros(len(counts), np.uint8 if len(used) <= 255 else np.uint16)
    lookup[used] = np.arange(1, len(used) + 1)
    step = process.rules.diameter_step_nm
    classes = np.empty(drawn.shape, lookup.dtype)
    for rows in _row_blocks(drawn):
        np.take(lookup, drawn[rows], out=classes[rows])
    return Cells(classes, used * step, counts[used], step / 2)


def drawn_steps(diameters: DiameterMap, process: Process) -> Array:
    """(y, x) uint16 drawn diameters in steps of ``diameter_step_nm``, 0 where there is no pillar.

    The bias is looked up in a table of 1/16 nm; isolation is worked out where the process knows it.
    """
    design = diameters.diameter_um
    step = process.rules.diameter_step_nm
    table = np.arange(round(float(design.max(initial=0)) * _FINE / nm) + 2) / _FINE
    straight = np.rint(process.written_diameter_nm(table) / step)
    straight[0] = 0
    lookup = np.clip(straight, 0, 65535).astype(np.uint16)
    drawn = np.empty(design.shape, np.uint16)
    for rows in _row_blocks(design):
        index = np.rint(np.multiply(design[rows], _FINE / nm, dtype=np.float32)).astype(np.int32)
        np.take(lookup, index, out=drawn[rows])
    if process.bias.isolated_nm:
        _add_isolation(drawn, diameters, process)
    _refuse_impossible(drawn, diameters, step)
    return drawn


def _row_blocks(array: Array, sites: int = 1 << 20) -> Iterator[slice]:
    """Blocks of rows, so that what is made on the way stays small."""
    size = max(1, sites // max(1, array.shape[1]))
    for first in range(0, array.shape[0], size):
        yield slice(first, first + size)


def _add_isolation(drawn: Array, diameters: DiameterMap, process: Process) -> None:
    """Replace, in place, the drawn diameters of pillars that lack neighbours."""
    design = diameters.diameter_um
    alone = isolation.isolation(design > 0, diameters.pitch_um, process.bias.range_um)
    rows, columns = np.nonzero((alone > 0) & (design > 0))
    if not len(rows):
        return
    wanted = process.written_diameter_nm(design[rows, columns] / nm, alone[rows, columns])
    drawn[rows, columns] = np.clip(np.rint(wanted / process.rules.diameter_step_nm), 0, 65535)


def _refuse_impossible(drawn: Array, diameters: DiameterMap, step: int) -> None:
    widest = int(drawn.max(initial=0)) * step * nm
    if widest >= diameters.pitch_um:
        row, column = divmod(int(drawn.argmax()), drawn.shape[1])
        raise ProcessError(
            f"drawn diameter at row {row}, column {column} is {widest:g} um, need less than the pitch of "
            f"{diameters.pitch_um:g} um; cap the diameters or check the bias"
        )
    for rows in _row_blocks(drawn):
        vanished = (drawn[rows] == 0) & (diameters.diameter_um[rows] > 0)
        if vanished.any():
            block_row, column = (int(i) for i in np.argwhere(vanished)[0])
            row = rows.start + block_row
            raise ProcessError(
                f"pillar at row {row}, column {column}, {diameters.diameter_um[row, column]} um wide, would be drawn "
                f"with diameter 0 (step {step} nm); raise the smallest diameter or check the bias"
            )
