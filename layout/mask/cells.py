"""Diameter map to pillar classes: equal drawn diameters become one class, a site
becomes a class number.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from layout.mask.class_store import hold_on_disk
from layout.mask.plan import MOST_CLASSES, RowSource, row_blocks
from layout.process import isolation
from layout.process.process import Process
from metalens.core.arrays import Array
from metalens.core.errors import LensError, ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap

_FINE = 16  # table entries for one nanometre of designed diameter


@dataclass(frozen=True, eq=False)
class DrawnClasses:
    """Quantised drawn pillars.

    shape: (y, x) of the sites.
    source: class numbers of rows, uint8 or uint16, 0 for no pillar.
    diameters_nm: (k,) size of each class.
    counts: (k,) pillars of each class.
    """

    shape: tuple[int, int]
    source: RowSource
    diameters_nm: Array
    counts: Array

    @property
    def classes(self) -> Array:
        """All class numbers (y, x)."""
        return self.source(0, self.shape[0])


def quantise_diameters(diameters: DiameterMap, process: Process) -> DrawnClasses:
    """Drawn diameters (bias taken off) rounded to the diameter step of the process, as
    classes, thinnest first.

    Raises:
        ProcessError: more than 65 535 classes, a drawn pillar below one step, or one as
            wide as the pitch (row and column named).
        LensError: no pillar at all.
    """
    drawn = classify_keys(diameters, lambda: drawn_blocks(diameters, process))
    sizes_nm = drawn.diameters_nm * process.rules.diameter_step_nm
    return dataclasses.replace(drawn, diameters_nm=sizes_nm)


def classify_keys(
    diameters: DiameterMap, keys: Callable[[], Iterator[tuple[int, Array]]]
) -> DrawnClasses:
    """A class for each distinct key of the pillars; the keys stand for the diameters.

    Args:
        diameters: of the lens.
        keys: starts anew an iterator of (first row, (rows, columns) keys); 0 for no
            pillar. Keys of uint16 are looked up in a table.

    Raises:
        ProcessError: more than 65 535 classes.
        LensError: no pillar at all.
    """
    counts: Counter[int] = Counter()
    for _, block in keys():
        if block.dtype == np.uint16:
            numbers = np.bincount(block.ravel())
            values = np.flatnonzero(numbers)
            numbers = numbers[values]
        else:
            values, numbers = np.unique(block, return_counts=True)
        counts.update(dict(zip(values.tolist(), numbers.tolist(), strict=True)))
    counts.pop(0, None)
    if not counts:
        raise LensError("empty lens: the map holds no pillar; check the aperture")
    if len(counts) > MOST_CLASSES:
        raise ProcessError(
            f"{len(counts)} classes of pillars, at most {MOST_CLASSES}; raise "
            "diameter_step_nm or angle_step_deg"
        )
    used = np.array(sorted(counts))
    dtype = np.dtype(np.uint8 if len(used) <= 255 else np.uint16)

    def numbered(block: Array) -> Array:
        return np.searchsorted(used, block, side="right").astype(dtype)

    table = numbered(np.arange(1 << 16))
    rows, columns = diameters.diameter_um.shape
    blocks = (
        (first, table.take(block) if block.dtype == np.uint16 else numbered(block))
        for first, block in keys()
    )
    source = hold_on_disk((rows, columns), dtype, blocks)
    numbers = np.array([counts[key] for key in used.tolist()])
    return DrawnClasses((rows, columns), source, used, numbers)


def drawn_blocks(
    diameters: DiameterMap, process: Process
) -> Iterator[tuple[int, Array]]:
    """(first row, drawn diameters in steps) of blocks of rows.

    The bias is looked up in a table of 1/16 nm. Isolation is computed where the process
    has a bias for it.
    """
    pitch = diameters.pitch_um
    step = process.rules.diameter_step_nm
    table = np.arange(round(pitch * _FINE / nm) + 2) / _FINE
    drawn_steps = np.rint(process.written_diameter_nm(table) / step)
    drawn_steps[0] = 0
    lookup = np.clip(drawn_steps, 0, 65535).astype(np.uint16)
    for first, block, alone in with_isolation(diameters, process):
        drawn = lookup.take(
            np.rint(np.multiply(block, _FINE / nm, dtype=np.float32)).astype(np.int32)
        )
        if alone is not None:
            _add_isolation(drawn, block, alone, process)
        _refuse_impossible(drawn, block, first, pitch, step)
        yield first, drawn


def with_isolation(
    diameters: DiameterMap, process: Process
) -> Iterator[tuple[int, Array, Array | None]]:
    """Designed sizes and isolation of the pillars, in blocks of rows.

    Args:
        diameters: designed sizes.
        process: bias of isolated pillars, and its range.

    Yields:
        (first row, sizes in um, isolation from 0 to 1); the third is None where the
        process has no such bias.
    """
    design = diameters.diameter_um
    bias = process.bias
    for first, block in row_blocks(lambda low, end: design[low:end], design.shape):
        alone = None
        if bias.isolated_nm:
            alone = isolation.isolation_rows(
                lambda low, end: np.asarray(design[low:end]) > 0,
                first,
                first + len(block),
                diameters.steps_um,
                bias.range_um,
                centred=diameters.lattice.centred,
            )
        yield first, block, alone


def _add_isolation(drawn: Array, design: Array, alone: Array, process: Process) -> None:
    """Replace, in place, the drawn diameters of pillars that lack neighbours."""
    rows, columns = np.nonzero((alone > 0) & (design > 0))
    if not len(rows):
        return
    drawn_nm = process.written_diameter_nm(
        design[rows, columns] / nm, alone[rows, columns]
    )
    drawn[rows, columns] = np.clip(
        np.rint(drawn_nm / process.rules.diameter_step_nm), 0, 65535
    )


def _refuse_impossible(
    drawn: Array, design: Array, first: int, pitch_um: float, step: int
) -> None:
    """Refuse drawn pillars as wide as the pitch, or of diameter 0.

    Args:
        drawn: (rows, columns) drawn diameters in steps.
        design: (rows, columns) designed diameters, um.
        first: number of the first row.
        pitch_um: of the lattice.
        step: diameter step, nm.

    Raises:
        ProcessError: such a pillar, with row and column.
    """
    widest = int(drawn.max(initial=0)) * step * nm
    if widest >= pitch_um:
        row, column = divmod(int(drawn.argmax()), drawn.shape[1])
        raise ProcessError(
            f"drawn diameter at row {first + row}, column {column} is {widest:g} um, need less than the pitch of "
            f"{pitch_um:g} um; cap the diameters or check the bias"
        )
    has_vanished = (drawn == 0) & (design > 0)
    if has_vanished.any():
        row, column = (int(i) for i in np.argwhere(has_vanished)[0])
        raise ProcessError(
            f"pillar at row {first + row}, column {column}, {design[row, column]} um wide, would be drawn "
            f"with diameter 0 (step {step} nm); raise the smallest diameter or check the bias"
        )
