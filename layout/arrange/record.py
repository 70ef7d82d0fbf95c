"""What stands on a die and on a wafer, as ARRANGEMENT.toml says it: lenses, cells of
other files, a raster of dies.
"""

from dataclasses import dataclass, field
from pathlib import Path

from layout.process import names
from layout.process.process import check_positive
from metalens.core.errors import ProcessError

MOST_DIES = 1_000_000


@dataclass(frozen=True)
class PartInstances:
    """Where a lens or cell is placed, once or as an array.

    x_um, y_um: of its origin (the axis of a lens); of the first one of an array.
    turn_deg: counter-clockwise. mirrored: at the x axis, before the turn (turns a
    lens's circular handedness too).
    columns, rows: of an array. step_um: (x, y) from one to the next; needed where there
    are several.
    """

    x_um: float = field(default=0.0, metadata={"signed": True})
    y_um: float = field(default=0.0, metadata={"signed": True})
    turn_deg: float = 0.0
    mirrored: bool = False
    columns: int = 1
    rows: int = 1
    step_um: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 1 or self.columns * self.rows > MOST_DIES:
            raise ProcessError(
                f"columns x rows = {self.columns} x {self.rows}: need from 1 to {MOST_DIES} copies"
            )
        if self.columns * self.rows > 1 and self.step_um is None:
            raise ProcessError(
                f"step_um is missing for {self.columns} columns and {self.rows} rows"
            )
        check_positive(self, "step_um")


@dataclass(frozen=True)
class LensPart:
    """A lens on the die, drawn, corrected and checked by itself.

    file: lens.h5, in the folder of the arrangement. name: of its cell, and the beginning of the
    names of its pillars' cells.
    furnished: with marks, label, dose test and witness cells of its own, else with its
    aperture alone; left out: where no [die] is given.
    at: where it stands; left out: once, at (0, 0).
    """

    file: Path
    name: str
    furnished: bool | None = None
    at: tuple[PartInstances, ...] = (PartInstances(),)

    def __post_init__(self) -> None:
        _named(self.name)


@dataclass(frozen=True)
class CellPart:
    """A cell of another GDSII or OASIS file.

    file: beside the arrangement. cell: what is placed, with all below it; left out: the
    file's only top cell.
    name: of the part in reports. relative_dose: of its layers, where no doses.csv of
    these lies beside the file; a single dose is no proximity correction.
    checked: whether its design rules are checked; where not, every verdict says so.
    at: where it stands; left out: once, at (0, 0).
    """

    file: Path
    name: str
    cell: str = ""
    relative_dose: float = field(default=1.0, metadata={"above": 0})
    checked: bool = True
    at: tuple[PartInstances, ...] = (PartInstances(),)

    def __post_init__(self) -> None:
        _named(self.name)


@dataclass(frozen=True)
class FrameSettings:
    """Marks, label, dose test and witness cells once for all lenses of the die.

    size_um: (x, y) of the die. label: text on it; left out: the name of the
    arrangement.
    """

    size_um: tuple[float, float]
    label: str = ""

    def __post_init__(self) -> None:
        check_positive(self, "size_um")


@dataclass(frozen=True)
class WaferMark:
    """Middle of an alignment mark of the wafer.

    x_mm, y_mm: from the middle of the wafer.
    """

    x_mm: float = field(metadata={"signed": True})
    y_mm: float = field(metadata={"signed": True})


@dataclass(frozen=True)
class WaferSettings:
    """Dies side by side on a round wafer, its flat or notch at the lowest y.

    diameter_mm: of the wafer. edge_exclusion_mm: from its edge, flat or notch, where no
    part of a die may lie.
    flat_mm: length of the flat; 0: none. notch_mm: depth of the notch (a V
    of 90 degrees, SEMI M1: 1 mm); 0: none.
    pitch_um: (x, y) from die to die. offset_um: of the middle of a die from the middle
    of the wafer.
    mark_um, mark_width_um: arm length and line width of the wafer's alignment crosses,
    with a thin cross in their
        middle for the fine alignment. marks: where they stand; dies that would touch
        one are left out.
    """

    pitch_um: tuple[float, float]
    diameter_mm: float = 100.0
    edge_exclusion_mm: float = 3.0
    flat_mm: float = 0.0
    notch_mm: float = 0.0
    offset_um: tuple[float, float] = (0.0, 0.0)
    mark_um: float = 400.0
    mark_width_um: float = 20.0
    marks: tuple[WaferMark, ...] = ()

    def __post_init__(self) -> None:
        """Refuse values out of range, and settings that contradict each other."""
        check_positive(self, "pitch_um", "diameter_mm", "mark_um", "mark_width_um")
        if any(abs(1e3 * pitch - round(1e3 * pitch)) > 1e-6 for pitch in self.pitch_um):
            raise ProcessError(
                f"pitch_um = {list(self.pitch_um)}: need whole nanometres, so that all dies are equal"
            )
        for name in ("edge_exclusion_mm", "flat_mm", "notch_mm"):
            if not 0 <= getattr(self, name) < self.diameter_mm / 2:
                raise ProcessError(
                    f"{name} = {getattr(self, name)}: need from 0 to the radius of the wafer"
                )
        if self.flat_mm and self.notch_mm:
            raise ProcessError(
                f"flat_mm = {self.flat_mm} and notch_mm = {self.notch_mm}: a wafer has one of them"
            )
        if self.mark_um < 10 * self.mark_width_um:
            raise ProcessError(
                f"mark_um = {self.mark_um}: need ten times mark_width_um = {self.mark_width_um}, for the fine cross"
            )


@dataclass(frozen=True)
class DieFloorplan:
    """Lenses and cells on a die, the die alone or on a wafer.

    name: of the top cell; ``NAME_DIE`` is the die on a wafer.
    lens, cell: what stands on the die. die: furniture for all lenses together. wafer:
    step and repeat of the die.
    """

    name: str = "ARRANGED"
    lens: tuple[LensPart, ...] = ()
    cell: tuple[CellPart, ...] = ()
    die: FrameSettings | None = None
    wafer: WaferSettings | None = None

    def __post_init__(self) -> None:
        """Refuse an empty floorplan, and names used twice."""
        _named(self.name)
        if not self.lens and not self.cell:
            raise ProcessError("nothing to arrange: need a [[lens]] or a [[cell]]")
        if self.die is not None and not self.lens:
            raise ProcessError(
                "[die] needs a [[lens]]: its dose test and witness cells are made of the lens's pillars"
            )
        used_names = [self.name, "WMARK", *(part.name for part in self.parts)]
        if self.die is not None:
            used_names.append("DIE")
        names.check_distinct_names(used_names)

    @property
    def parts(self) -> list[LensPart | CellPart]:
        """Lenses, then cells."""
        return [*self.lens, *self.cell]

    def furnished(self, part: LensPart) -> bool:
        """Whether a lens brings marks, label and test structures of its own."""
        return self.die is None if part.furnished is None else part.furnished


def _named(name: str) -> None:
    """Refuse an illegal name, or more than 12 characters."""
    names.check_cell_name(name)
    if len(name) > 12:
        raise ProcessError(
            f"name {name!r}: need at most 12 characters, cells of its parts begin with it"
        )
