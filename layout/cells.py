"""Diameter map to pillar classes: equal drawn diameters become one class, a site becomes a class number."""

from dataclasses import dataclass

import numpy as np

from layout import bias
from layout.mask import MOST_CLASSES
from layout.process import Process
from metalens.errors import LensError, ProcessError
from metalens.lens import DiameterMap
from metalens.store import Array
from metalens.units import nm

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
    counts = np.bincount(drawn.ravel())
    if counts[1:].sum() == 0:
        raise LensError("empty lens: the map holds no pillar; check the aperture")
    used = np.flatnonzero(counts)
    used = used[used > 0]
    if len(used) > MOST_CLASSES:
        raise ProcessError(f"{len(used)} different diameters, at most {MOST_CLASSES}; raise diameter_step_nm")
    lookup = np.zeros(len(counts), np.uint8 if len(used) <= 255 else np.uint16)
    lookup[used] = np.arange(1, len(used) + 1)
    step = process.rules.diameter_step_nm
    return Cells(lookup[drawn], used * step, counts[used], step / 2)


def drawn_steps(diameters: DiameterMap, process: Process) -> Array:
    """(y, x) uint16 drawn diameters in steps of ``diameter_step_nm``, 0 where there is no pillar.

    The bias is looked up in a table of 1/16 nm; isolation is worked out where the process knows it.
    """
    design = diameters.diameter_um
    index = np.rint(np.multiply(design, _FINE / nm, dtype=np.float32)).astype(np.int32)
    step = process.rules.diameter_step_nm
    table = np.arange(int(index.max(initial=0)) + 1) / _FINE
    straight = np.rint(process.written_diameter_nm(table) / step)
    straight[0] = 0
    drawn = np.clip(straight, 0, 65535).astype(np.uint16)[index]
    if process.bias.isolated_nm:
        _add_isolation(drawn, diameters, process)
    _refuse_impossible(drawn, diameters, step)
    return drawn


def _add_isolation(drawn: Array, diameters: DiameterMap, process: Process) -> None:
    """Replace, in place, the drawn diameters of pillars that lack neighbours."""
    design = diameters.diameter_um
    alone = bias.isolation(design > 0, diameters.pitch_um, process.bias.range_um)
    rows, columns = np.nonzero((alone > 0) & (design > 0))
    if not len(rows):
        return
    wanted = process.written_diameter_nm(design[rows, columns] / nm, alone[rows, columns])
    drawn[rows, columns] = np.rint(wanted / process.rules.diameter_step_nm)


def _refuse_impossible(drawn: Array, diameters: DiameterMap, step: int) -> None:
    widest = int(drawn.max(initial=0)) * step * nm
    if widest >= diameters.pitch_um:
        row, column = np.unravel_index(int(drawn.argmax()), drawn.shape)
        raise ProcessError(
            f"drawn diameter at row {row}, column {column} is {widest:g} um, need less than the pitch of "
            f"{diameters.pitch_um:g} um; cap the diameters or check the bias"
        )
    vanished = (drawn == 0) & (diameters.diameter_um > 0)
    if vanished.any():
        row, column = np.unravel_index(int(vanished.argmax()), drawn.shape)
        raise ProcessError(
            f"pillar at row {row}, column {column}, {diameters.diameter_um[row, column]} um wide, would be drawn with "
            f"diameter 0 (step {step} nm); raise the smallest diameter or check the bias"
        )
