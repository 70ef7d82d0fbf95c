"""Names of the design guide's cells: what each knob may be, and what a reader sees of
it.
"""

import math
import re
from dataclasses import dataclass, fields, replace
from typing import Any

from benchmarks.design_guide_image import HELD
from codesign.evaluate.reader import ReaderConfig

READERS = ("reference", "network")
LENS = re.compile(
    r"(free-|radial-)?(focus|quadratic|(?<!free-)stop|(?<!radial-)oblique|(?<!-)helix|(?<!-)split)(\d+)"
)


@dataclass(frozen=True, slots=True)
class Place:
    """Part of the field that a camera sees: width of its square sensor, and field angle
    of the middle.

    share: (y, x) of the field that its PSFs vary over; held along an axis, they are
    those of its middle.
    """

    width_um: float
    angle_deg: float
    share: tuple[float, float] = (1.0, 1.0)


FIELDS = {
    "axis": Place(1008.0, 0.0),
    "oblique": Place(1008.0, 17.0),
    "ring": Place(1872.0, 0.0),
    "line": Place(1008.0, 17.0, (HELD, 1.0)),
    "angle": Place(1008.0, 17.0, (HELD, HELD)),
}


def corner_rad(place: Place, distance_um: float = 2000.0) -> float:
    """Field angle of the farthest corner of what a camera sees."""
    half, aside = (
        place.width_um / 2,
        distance_um * math.tan(math.radians(place.angle_deg)),
    )
    return math.atan(math.hypot(abs(aside) + half, half) / distance_um)


@dataclass(frozen=True, slots=True)
class Cell:
    """Values of all knobs; the defaults are the base.

    lens: ``focusF``, hyperbolic, for sources at F mm. ``quadraticF``: r² alone, whose
    blur is the same over the field,
        in six radial terms. ``obliqueF``: free of aberrations at the middle of the
        field. ``helixN``: double helix of N
        rings. ``splitA``: two halves whose images lie A um apart. ``free-`` before one
        of the first three, ``radial-``
        before one of the first two: 63 or 6 terms trained with the reader from there.
        ``stopF``: six radial terms
        behind a stop on the other face of the substrate
        (:mod:`benchmarks.design_guide_stop`); ``radial-`` too.
    field: of :data:`FIELDS`. fwhm: of the light, nm. pitch: of the pixels, um.
    electrons: from white in 9 um.
    frames: that the reader learns from. reader: the ``reference``, or the elastic
    ``network``.
    """

    lens: str = "focus40"
    field: str = "axis"
    fwhm: float = 0.0
    pitch: float = 18.0
    electrons: float = 2000.0
    frames: int = 3200
    reader: str = "reference"

    @property
    def name(self) -> str:
        """What differs from the base."""
        values = ((f.name, getattr(self, f.name), f.default) for f in fields(self))
        return (
            ",".join(
                f"{n}={v}" if isinstance(v, str) else f"{n}={v:g}"
                for n, v, d in values
                if v != d
            )
            or "base"
        )

    @property
    def light(self) -> "Cell":
        """The cell of the base lens in the same field, light and pixels: what a ratio
        is taken to.
        """
        return replace(self, lens=Cell().lens)

    @property
    def config(self) -> ReaderConfig:
        """Settings of the reader but for the seed."""
        pixels = round(FIELDS[self.field].width_um / self.pitch)
        return ReaderConfig(
            frames=self.frames,
            pixels=pixels,
            pitch_um=self.pitch,
            electrons=self.electrons,
            fwhm_nm=self.fwhm,
        )

    @property
    def design(self) -> str:
        """Name of the cell that a lens is designed for: who reads it, after how many
        frames, has no part in it.
        """
        return replace(self, frames=Cell().frames, reader=Cell().reader).name


def cell_of(name: str) -> Cell:
    """The cell of a name.

    Raises:
        SystemExit: a knob or a value that there is not, with those that there are.
    """
    kinds = {f.name: type(f.default) for f in fields(Cell)}
    found: dict[str, Any] = {}
    for part in [] if name == "base" else name.split(","):
        knob, _, value = part.partition("=")
        if knob not in kinds or knob in found:
            raise SystemExit(
                f"cell {name!r}: no knob {knob!r} (or twice): need {', '.join(kinds)}, or base alone"
            )
        try:
            found[knob] = kinds[knob](value)
        except ValueError:
            raise SystemExit(
                f"cell {name!r}: {knob} = {value!r} is no number"
            ) from None
    cell = Cell(**found)
    if cell.field not in FIELDS or not LENS.fullmatch(cell.lens):
        raise SystemExit(
            f"cell {name!r}: field = {cell.field!r}, lens = {cell.lens!r}: need one of {', '.join(FIELDS)} and a lens: "
            "focusF, quadraticF, obliqueF, helixN, splitA, stopF; free- before one of the first three, "
            "radial- of the first two and of stopF"
        )
    if cell.reader not in READERS:
        raise SystemExit(
            f"cell {name!r}: reader = {cell.reader!r}: need one of {', '.join(READERS)}"
        )
    if cell.reader == "network" and FIELDS[cell.field].share != (1.0, 1.0):
        raise SystemExit(
            f"cell {name!r}: the network trains on the true image: need a field that is not held"
        )
    return cell


def run_of(name: str) -> tuple[Cell, int]:
    """Cell and seed of a run ``CELL/SEED``."""
    cell, _, seed = name.rpartition("/")
    if not seed.isdecimal():
        raise SystemExit(f"run {name!r}: need CELL/SEED, as base/0")
    return cell_of(cell), int(seed)
