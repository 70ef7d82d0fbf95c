"""Etch and exposure bias: the fabricated diameter against the drawn one, and its
inverse.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

# largest |d bias / d diameter|; above it the fixed-point inverse may not converge
STEEPEST = 0.5


@dataclass(frozen=True, slots=True)
class Bias:
    """Bias = fabricated diameter - drawn diameter, both at half the height of the pillar, for
    the drawn diameter.

    table_nm: (drawn diameter, bias) pairs, rising; linear between them, constant beyond
        the ends.
    csv: or a file of two columns, drawn diameter and bias in nm, with or without a
        head.
    isolated_nm: what a pillar without neighbours gains beyond one in a full lattice.
    range_um: distance (Gaussian 1/e radius) over which neighbours count for that.

    Raises:
        ProcessError: more than one source of the bias, a table that does not rise, a
            slope beyond +-0.5.
    """

    table_nm: tuple[tuple[float, float], ...] = ()
    csv: Path | None = None
    isolated_nm: float = field(default=0.0, metadata={"signed": True})
    range_um: float = 1.0

    def __post_init__(self) -> None:
        """Refuse several sources of the bias, impossible numbers and steep slopes.

        Raises:
            ProcessError: naming the setting.
        """
        if self.table_nm and self.csv is not None:
            raise ProcessError(
                "bias is given more than once; keep one of table_nm and csv"
            )
        numbers = np.array(
            [*np.ravel(self.table_nm), self.isolated_nm, self.range_um], float
        )
        if not np.isfinite(numbers).all():
            raise ProcessError(
                "bias holds a value that is not finite; need numbers in nm"
            )
        if self.range_um <= 0:
            raise ProcessError(f"range_um = {self.range_um}: need a distance above 0")
        drawn = np.array([pair[0] for pair in self.table_nm])
        if (np.diff(drawn) <= 0).any() or (drawn <= 0).any():
            raise ProcessError(
                f"diameters of the bias table must rise and be above 0, got {drawn.tolist()}"
            )
        slope = np.diff(self.at(drawn)) / np.diff(drawn)
        if slope.size and abs(slope).max() > STEEPEST:
            at = int(abs(slope).argmax())
            raise ProcessError(
                f"bias changes by {slope[at]:.2f} nm per nm at {drawn[at]:g} nm, need at most {STEEPEST}: "
                "the drawn diameter could not be computed from the fabricated one; check the table"
            )

    def at(self, drawn_nm: Array | float) -> Array:
        """Bias in nm of pillars in a full lattice; shape of ``drawn_nm``."""
        drawn = np.asarray(drawn_nm, float)
        if self.table_nm:
            knots, values = np.array(self.table_nm).T
            return np.asarray(np.interp(drawn, knots, values))
        return np.zeros_like(drawn)

    def fabricated_nm(
        self, drawn_nm: Array | float, isolation: Array | float = 0.0
    ) -> Array:
        """Fabricated diameter in nm: drawn + bias(drawn) + isolated_nm × isolation.

        Args:
            drawn_nm: drawn diameter.
            isolation: 0 in a full lattice, 1 alone.
        """
        drawn = np.asarray(drawn_nm, float)
        return np.asarray(
            drawn + self.at(drawn) + self.isolated_nm * np.asarray(isolation)
        )

    def drawn_nm(
        self, fabricated_nm: Array | float, isolation: Array | float = 0.0
    ) -> Array:
        """Drawn diameter in nm for a fabricated one, inverse of :meth:`fabricated_nm`, to
        1e-9 nm.

        Fixed point of drawn = goal - bias(drawn); each iteration at least halves the
        error.

        Args:
            fabricated_nm: diameter after fabrication.
            isolation: 0 in a full lattice, 1 alone.
        """
        goal = np.asarray(fabricated_nm, float) - self.isolated_nm * np.asarray(
            isolation
        )
        drawn = goal.copy()
        for _ in range(60):
            before = drawn
            drawn = goal - self.at(drawn)
            if np.abs(drawn - before).max(initial=0.0) < 1e-10:
                break
        return np.asarray(drawn)


def read_csv(path: str | Path) -> tuple[tuple[float, float], ...]:
    """(drawn diameter, bias) pairs in nm from a file of two columns.

    A first line of words is a header. Columns are separated by commas, or by
    semicolons, tabs or blanks with decimal commas.

    Args:
        path: of a table of two columns.

    Raises:
        ProcessError: missing file, a line that is not two numbers (line named), or no
            line at all.
    """
    path = Path(path)
    try:
        lines = reading.read_text(path).replace('"', "").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ProcessError(f"{path}: cannot be read as a table ({error})") from None
    rows = [
        (n, line)
        for n, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if rows and rows[0][1].lstrip()[0] not in "+-.0123456789":
        del rows[0]  # names of the columns
    pairs = []
    for number, line in rows:
        try:
            first, second = (float(cell) for cell in reading.split_columns(line))
        except ValueError:
            raise ProcessError(
                f"{path}, line {number}: {line[:60]!r}, need two numbers"
            ) from None
        pairs.append((first, second))
    if not pairs:
        raise ProcessError(f"{path}: holds no numbers; need lines of two columns")
    return tuple(pairs)
