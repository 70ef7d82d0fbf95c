"""The lens that is handed on: a diameter map, and what is needed to know its phase at any wavelength."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import h5py
import numpy as np

from metalens.cell import Cell, Lattice
from metalens.ground import config, store
from metalens.ground.arrays import Array
from metalens.ground.errors import LensError
from metalens.ground.reading import reader
from metalens.ground.store import Provenance
from metalens.lens.layers import Layers, check_gaps
from metalens.lens.rows import RowsOnDisk
from metalens.pillars import Proxy

_BLOCK_ROWS = 256
_NAME = "diameter_um"
Hand = Literal["", "left", "right"]
HANDS: dict[str, float] = {"": 0.0, "left": -2.0, "right": 2.0}  # phase in turns of the pillar, by incoming hand
MOST_HELD_BYTES = 1 << 26  # of diameters, beyond which the mask reads them from the file row by row


class Grid(NamedTuple):
    """Distances of columns and rows, and the area of a pillar's cell; 0: as on a square lattice."""

    pitch_um: float
    row_um: float = 0.0
    site_um2: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class DiameterMap:
    """Pillar sizes on a lattice; the lens axis sits at index ((ny-1)/2, (nx-1)/2).

    A hexagonal lattice is every other site of a grid of half a pitch along x and ``row_um`` along y: those with
    row + column odd hold no pillar.

    diameter_um: (y, x) size of every pillar (its diameter where it is round), 0 where there is no pillar and no light
        passes; +x right, +y down.
    pitch_um: lattice constant.
    lattice: square, rectangular or hexagonal.
    row_um: distance of the rows; 0 for that of the lattice (a mask on a grid may need another, by a fraction).
    angle_rad: (y, x) turn of every pillar in the plane, from +x to +y, beside that of the shape; None for none.

    Raises:
        LensError: not 2-D, non-finite, negative, or as wide as the pitch (row and column named); no pillar; a pillar
            between the sites of the lattice; turns that do not fit the map.
    """

    diameter_um: Array
    pitch_um: float
    lattice: Lattice = field(default_factory=Lattice)
    row_um: float = 0.0
    angle_rad: Array | None = None

    def __post_init__(self) -> None:
        d = self.diameter_um
        if d.ndim != 2:
            raise LensError(f"diameter map has shape {d.shape}, need (y, x)")
        if not 0.9 * self.lattice_row_um <= (self.row_um or self.lattice_row_um) <= 1.1 * self.lattice_row_um:
            raise LensError(
                f"row_um = {self.row_um}: rows of this {self.lattice.kind} lattice lie {self.lattice_row_um:.6g} um "
                "apart; need 0, or that within 10 %"
            )
        widest, thinnest = float(d.max(initial=0)), float(d.min(initial=0))
        if not (thinnest >= 0 and widest < self.pitch_um):
            row, column = _first_bad(d, self.pitch_um)
            raise LensError(
                f"diameter at row {row}, column {column} is {d[row, column]} um, "
                f"need 0 (no pillar) or 0 < diameter < pitch {self.pitch_um} um"
            )
        if widest == 0:
            raise LensError("empty aperture: the map holds no pillar; check the aperture and the profile")
        turn = self.angle_rad
        if turn is not None and not (turn.shape == d.shape and np.isfinite(turn).all()):
            raise LensError(f"angle_rad of shape {turn.shape}: need finite turns of the {d.shape} map of diameters")
        if self.lattice.centred:
            for row in range(min(2, len(d))):
                if np.asarray(d[row::2])[:, 1 - row :: 2].any():
                    raise LensError("a pillar between the sites of the hexagonal lattice: row + column is odd there")

    @property
    def lattice_row_um(self) -> float:
        """Distance of the rows of an exact lattice."""
        return self.lattice.periods_um(self.pitch_um)[1] / (2 if self.lattice.centred else 1)

    @property
    def steps_um(self) -> tuple[float, float]:
        """(x, y) distance of neighbouring columns and rows of the map."""
        return self.pitch_um / (2 if self.lattice.centred else 1), self.row_um or self.lattice_row_um

    @property
    def site_um2(self) -> float:
        """Area of the cell of one pillar."""
        x, y = self.steps_um
        return x * y * (2 if self.lattice.centred else 1)

    @property
    def grid(self) -> "Grid":
        """The map's sites as :func:`metalens.propagate.case` takes them; zeros on a square lattice."""
        square = self.lattice.kind == "square" and not self.row_um
        column, row = self.steps_um
        return Grid(column) if square else Grid(column, row, self.site_um2)

    @property
    def plain(self) -> bool:
        """Whether it is a square lattice of pillars that are not turned."""
        return self.lattice.kind == "square" and not self.row_um and self.angle_rad is None

    @property
    def x_um(self) -> Array:
        """(x,) positions of the columns."""
        return _axis(self.diameter_um.shape[1], self.steps_um[0])

    @property
    def y_um(self) -> Array:
        """(y,) positions of the rows."""
        return _axis(self.diameter_um.shape[0], self.steps_um[1])

    @property
    def radius_um(self) -> float:
        """Distance from the axis to the outermost pillar centre; memory of a few rows."""
        farthest = 0.0
        for start in range(0, len(self.diameter_um), _BLOCK_ROWS):
            rows = slice(start, start + _BLOCK_ROWS)
            there = self.diameter_um[rows] > 0
            held = there.any(axis=1)
            if held.any():
                first, last = there.argmax(axis=1), there.shape[1] - 1 - there[:, ::-1].argmax(axis=1)
                outer = np.maximum(np.abs(self.x_um[first]), np.abs(self.x_um[last]))
                farthest = max(farthest, float(np.hypot(outer, self.y_um[rows])[held].max()))
        return farthest


@dataclass(frozen=True, eq=False, slots=True)
class Lens:
    """A designed (or as-built) metalens.

    diameters: of every pillar.
    cell: the pillar cell that the proxy was made for.
    proxy: diameter and wavelength to phase and transmission (paper Eq. 2).
    wavelength_um: of the design.
    sensor_distance_um: lens to sensor, in the cover medium.
    source_distance_um: object distance of best focus (inf for a collimated beam).
    profile: name of the design (hyperbolic, double-helix, cubic, fisher, map, as-built).
    provenance: config and inputs that made it.
    layers: films in front and behind; their cover is that of the cell.
    hand: circular light that the lens is made for: "right" (field x + iy, the phase grows by twice the turn of a
        pillar) or "left"; the proxy is then that of the light that leaves with the other hand. Empty: any light.

    Raises:
        LensError: layers with another cover than the cell's; turned pillars without a hand, or the other way round;
            PropagationError: films thicker than their gap.
    """

    diameters: DiameterMap
    cell: Cell
    proxy: Proxy
    wavelength_um: float
    sensor_distance_um: float
    source_distance_um: float
    profile: str
    provenance: Provenance = field(default_factory=Provenance)
    layers: Layers = field(default_factory=Layers)
    hand: Hand = ""

    def __post_init__(self) -> None:
        if bool(self.hand) != (self.diameters.angle_rad is not None) or self.hand not in HANDS:
            raise LensError(f"hand = {self.hand!r}: need left or right where pillars are turned one by one, else none")
        cover = self.cell.cover
        if self.layers.cover not in (None, cover):
            raise LensError(
                f"layers: cover {self.layers.cover!r}, but the pillars' cell has {cover!r}; leave cover out"
            )
        object.__setattr__(self, "layers", replace(self.layers, cover=cover))
        check_gaps(self.layers, self.sensor_distance_um, self.source_distance_um)

    def phase_rad(self, wavelength_um: float | None = None, angle_rad: float = 0.0) -> Array:
        """(y, x) phase of every pillar through the proxy, and of its turn; 0 where there is none."""
        d = self.diameters.diameter_um
        inside = np.where(d > 0, d, self.proxy.domain_um[0])
        phase = self.proxy.phase_rad(inside, self._at(wavelength_um), angle_rad)
        return np.where(d > 0, phase + self.geometric_rad(slice(None)), 0)

    def geometric_rad(self, rows: slice) -> Array | float:
        """Phase that turned pillars give circular light, plus or minus twice the turn; 0 where none is turned."""
        turn = self.diameters.angle_rad
        return 0.0 if turn is None else np.asarray(HANDS[self.hand] * turn[rows], float)

    def transmission(self, wavelength_um: float | None = None, angle_rad: float = 0.0) -> Array:
        """(y, x) magnitude |T| <= 1 of every pillar; 0 where there is none."""
        d = self.diameters.diameter_um
        inside = np.where(d > 0, d, self.proxy.domain_um[0])
        level = self.proxy.transmission(inside, self._at(wavelength_um), angle_rad)
        return np.where(d > 0, level, 0)

    def _at(self, wavelength_um: float | None) -> float:
        return self.wavelength_um if wavelength_um is None else wavelength_um


def save(path: str | Path, lens: Lens) -> None:
    """Write a lens file (kind ``lens``); diameters keep their dtype."""
    arrays, attributes = parts(lens)
    store.save(path, "lens", arrays, attributes=attributes, provenance=lens.provenance)


@reader
def load(path: str | Path) -> Lens:
    """Read a lens file.

    Raises:
        StoreError: not a lens file; LensError: its diameters are invalid.
    """
    stored = store.load(path, "lens")
    lens = from_parts(stored.arrays, stored.attributes, where=str(path))
    return replace(lens, provenance=stored.provenance)


@reader
def load_plain(path: str | Path) -> Lens:
    """As :func:`load`, for what knows only round or fixed pillars on a square lattice.

    Raises:
        LensError: another lattice, or pillars that are turned one by one.
    """
    made = load(path)
    if not made.diameters.plain:
        turned = ", turned one by one" if made.hand else ""
        raise LensError(
            f"{path}: pillars on a {made.diameters.lattice.kind} lattice{turned}; this command takes a square lattice "
            "of pillars that are not turned (psf, layout and view take any)"
        )
    return made


def _first_bad(d: Array, pitch_um: float) -> tuple[int, int]:
    """(row, column) of the first diameter that cannot be."""
    for first in range(0, len(d), _BLOCK_ROWS):
        block = np.asarray(d[first : first + _BLOCK_ROWS])
        wrong = np.argwhere(~((block >= 0) & (block < pitch_um)))
        if len(wrong):
            return first + int(wrong[0, 0]), int(wrong[0, 1])
    return 0, 0


@reader
def streamed(path: str | Path) -> Lens:
    """As :func:`load`; diameters that would take much memory stay in the file, as :class:`RowsOnDisk`.

    What looks at them in blocks of rows (the mask) needs no more; ``numpy.asarray`` gives all of them.
    """
    large = False
    with contextlib.suppress(*store.DAMAGE), h5py.File(path, "r") as file:  # damage is told by the loader
        large = file[_NAME].nbytes > MOST_HELD_BYTES
    if not large:
        return load(path)
    stored = store.load(path, "lens", without=(_NAME,))
    held = {**stored.arrays, _NAME: cast(Array, RowsOnDisk(path, _NAME))}
    return replace(from_parts(held, stored.attributes, where=str(path)), provenance=stored.provenance)


def parts(lens: Lens, *, group: str = "") -> tuple[dict[str, Array], dict[str, Any]]:
    """(arrays, attributes) of a lens for a store file; ``group`` stands before the names of the arrays."""
    arrays: dict[str, Array] = {f"{group}diameter_um": lens.diameters.diameter_um}
    arrays |= {f"{group}proxy/{name}": array for name, array in lens.proxy.to_arrays().items()}
    attributes = {
        "pitch_um": lens.diameters.pitch_um,
        "cell": config.dumps(lens.cell),
        "wavelength_um": lens.wavelength_um,
        "sensor_distance_um": lens.sensor_distance_um,
        "source_distance_um": lens.source_distance_um,
        "profile": lens.profile,
    }
    d = lens.diameters
    if not d.plain:
        about = {"lattice": config.dumps(d.lattice), "row_um": d.steps_um[1], "shape": lens.cell.shape.name}
        attributes |= about | {"hand": lens.hand}
    if d.angle_rad is not None:
        arrays |= {f"{group}angle_rad": d.angle_rad}
    if lens.layers.films:
        attributes["layers"] = config.dumps(lens.layers)
    return arrays, attributes


def from_parts(arrays: Mapping[str, Array], attributes: Mapping[str, Any], *, where: str, group: str = "") -> Lens:
    """Inverse of :func:`parts`; ``where`` names the file in errors."""
    start = f"{group}proxy/"
    proxy = {name[len(start) :]: array for name, array in arrays.items() if name.startswith(start)}
    return Lens(
        diameters=_diameters(arrays, attributes, where, group),
        cell=config.loads(attributes["cell"], Cell, where=f"{where}: cell"),
        proxy=Proxy.from_arrays(proxy),
        wavelength_um=attributes["wavelength_um"],
        sensor_distance_um=attributes["sensor_distance_um"],
        source_distance_um=attributes["source_distance_um"],
        profile=attributes["profile"],
        layers=_layers(attributes, where),
        hand=attributes.get("hand", ""),
    )


def _diameters(arrays: Mapping[str, Array], attributes: Mapping[str, Any], where: str, group: str) -> DiameterMap:
    """The map of a file; on a square lattice in files that name none."""
    plain = DiameterMap(arrays[f"{group}diameter_um"], attributes["pitch_um"])
    if "lattice" not in attributes:
        return plain
    lattice = config.loads(attributes["lattice"], Lattice, where=f"{where}: lattice")
    row_um = 0.0 if lattice.kind == "square" else attributes["row_um"]
    return replace(plain, lattice=lattice, row_um=row_um, angle_rad=arrays.get(f"{group}angle_rad"))


def _layers(attributes: Mapping[str, Any], where: str) -> Layers:
    """The films of a file; none in files that name none."""
    text = attributes.get("layers")
    return Layers() if text is None else config.loads(text, Layers, where=f"{where}: layers")


def _axis(count: int, pitch_um: float) -> Array:
    return (np.arange(count) - (count - 1) / 2) * pitch_um
