"""The lens that is handed on: a diameter map, and what is needed to know its phase at
any wavelength.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from metalens.cell import Cell, Lattice
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.core.reading import read_hdf5, typed_reader
from metalens.core.store import Provenance
from metalens.lens.diameters import DiameterMap as DiameterMap
from metalens.lens.layers import Layers, check_gaps
from metalens.lens.neighbours import NeighbourRows
from metalens.lens.pairs import TwoSizeTable
from metalens.lens.rows import RowsOnDisk
from metalens.library import Proxy

_NAME = "diameter_um"
Hand = Literal["", "left", "right"]
HANDS: dict[str, float] = {
    "": 0.0,
    "left": -2.0,
    "right": 2.0,
}  # phase in turns of the pillar, by incoming hand
MOST_HELD_BYTES = (
    1 << 26
)  # of diameters, beyond which the mask reads them from the file row by row


@dataclass(frozen=True, eq=False, slots=True)
class Lens:
    """A designed (or as-built) metalens.

    diameters: of every pillar.
    cell: the pillar cell that the proxy was made for.
    proxy: diameter and wavelength to phase and transmission (paper Eq. 2).
    wavelength_um: of the design.
    sensor_distance_um: lens to sensor, in the cover medium.
    source_distance_um: object distance of best focus (inf for a collimated beam).
    profile: name of the design (hyperbolic, double-helix, cubic, fisher, map,
    as-built).
    provenance: config and inputs that made it.
    layers: films in front and behind; their cover is that of the cell.
    hand: circular light that the lens is made for: "right" (field x + iy, the phase
    grows by twice the turn of a
        pillar) or "left"; the proxy is then that of the light that leaves with the
        other hand. Empty: any light.
    pairs: table of pillars of two sizes in place of the proxy; None where they have
    one. light: polarisation, "x" or
        "y", that phase, transmission and distances are for where they have two
        (:meth:`seen`).
    neighbours: rows of its own unlike pillars (:func:`metalens.design.neighbours`),
    whose factor PSFs and images then
        hold; None where none was solved.

    Raises:
        LensError: layers with another cover than the cell's; turned pillars without a
            hand, or the other way round;
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
    pairs: TwoSizeTable | None = None
    light: Literal["x", "y"] = "x"
    neighbours: NeighbourRows | None = None

    def __post_init__(self) -> None:
        if (self.pairs is None) != (self.diameters.length_um is None) or (
            self.pairs is None and self.light != "x"
        ):
            raise LensError(
                "pairs: need the table of pillars where they have two sizes, and there alone"
            )
        if (
            bool(self.hand) != (self.diameters.angle_rad is not None)
            or self.hand not in HANDS
        ):
            raise LensError(
                f"hand = {self.hand!r}: need left or right where pillars are turned one by one, else none"
            )
        cover = self.cell.cover
        if self.layers.cover not in (None, cover):
            raise LensError(
                f"layers: cover {self.layers.cover!r}, but the pillars' cell has {cover!r}; leave cover out"
            )
        object.__setattr__(self, "layers", replace(self.layers, cover=cover))
        check_gaps(self.layers, self.sensor_distance_um, self.source_distance_um)

    @property
    def reduced_um(self) -> float:
        """Σ thickness / index from the pillars to the sensor: samples at x um show
        directions of tangent x over it.
        """
        return self.layers.after(self.sensor_distance_um, self.wavelength_um).reduced_um

    @property
    def one_light(self) -> str:
        """Which light the proxy is of, in words, where pillars of one size answer x and
        y apart; empty for others.
        """
        if self.hand or self.pairs is not None or self.cell.alike:
            return ""
        angled = self.proxy.max_angle_rad > 0
        return (
            "the mean of both polarisations, tilted along x"
            if angled
            else "light along x"
        )

    def seen(self, light: Literal["x", "y"]) -> "Lens":
        """The lens for light polarised along x or y, where it focuses that."""
        if self.pairs is None or self.light == light:
            return self
        mine = self.sensor_distance_um, self.source_distance_um
        sensor, source = self.pairs.focus_y_um  # of the other light, whichever that is
        other = replace(self.pairs, focus_y_um=mine)
        return replace(
            self,
            light=light,
            pairs=other,
            sensor_distance_um=sensor,
            source_distance_um=source,
        )

    def phase_rad(
        self, wavelength_um: float | None = None, angle_rad: float = 0.0
    ) -> Array:
        """(y, x) phase of every pillar through the proxy or the table, and of its turn;
        0 where there is none.
        """
        return self.rows_phase_rad(slice(None), wavelength_um, angle_rad)

    def rows_phase_rad(
        self, rows: slice, wavelength_um: float | None = None, angle_rad: float = 0.0
    ) -> Array:
        """As :meth:`phase_rad`, of some rows."""
        d = np.asarray(self.diameters.diameter_um[rows])
        if self.pairs is not None:
            return np.asarray(
                np.angle(self._amplitude(rows, self.pairs, wavelength_um))
            )
        inside = np.where(d > 0, d, self.proxy.domain_um[0])
        phase = self.proxy.phase_rad(inside, self._at(wavelength_um), angle_rad)
        return np.where(d > 0, phase + self.geometric_rad(rows), 0)

    def _amplitude(
        self, rows: slice, pairs: TwoSizeTable, wavelength_um: float | None
    ) -> Array:
        x, y = self.diameters.diameter_um[rows], self.diameters.length_um
        return pairs.amplitude(
            x, x if y is None else y[rows], self._at(wavelength_um), self.light
        )

    def geometric_rad(self, rows: slice) -> Array | float:
        """Phase that turned pillars give circular light, plus or minus twice the turn;
        0 where none is turned.
        """
        turn = self.diameters.angle_rad
        return 0.0 if turn is None else np.asarray(HANDS[self.hand] * turn[rows], float)

    def transmission(
        self, wavelength_um: float | None = None, angle_rad: float = 0.0
    ) -> Array:
        """(y, x) magnitude |T| <= 1 of every pillar; 0 where there is none."""
        if self.pairs is not None:
            return np.minimum(
                np.abs(self._amplitude(slice(None), self.pairs, wavelength_um)), 1.0
            )
        d = self.diameters.diameter_um
        inside = np.where(d > 0, d, self.proxy.domain_um[0])
        level = self.proxy.transmission(inside, self._at(wavelength_um), angle_rad)
        return np.where(d > 0, level, 0)

    def _at(self, wavelength_um: float | None) -> float:
        return self.wavelength_um if wavelength_um is None else wavelength_um


def save(path: str | Path, lens: Lens) -> None:
    """Write a lens file (kind ``lens``); diameters keep their dtype."""
    arrays, attributes = lens_to_parts(lens)
    store.save(path, "lens", arrays, attributes=attributes, provenance=lens.provenance)


@typed_reader
def load(path: str | Path) -> Lens:
    """Read a lens file.

    Raises:
        StoreError: not a lens file; LensError: its diameters are invalid.
    """
    stored = store.load(path, "lens")
    lens = lens_from_parts(stored.arrays, stored.attributes, where=str(path))
    return replace(lens, provenance=stored.provenance)


@typed_reader
def load_plain(path: str | Path) -> Lens:
    """As :func:`load`, for what knows only round or fixed pillars on a square lattice.

    Raises:
        LensError: another lattice, or pillars that are turned one by one.
    """
    made = load(path)
    if not made.diameters.plain:
        turned = (
            ", turned one by one"
            if made.hand
            else ", of two sizes"
            if made.pairs
            else ""
        )
        raise LensError(
            f"{path}: pillars on a {made.diameters.lattice.kind} lattice{turned}; this command takes a square lattice "
            "of pillars of one size that are not turned (psf, layout and view take any)"
        )
    return made


@typed_reader
def load_out_of_core(path: str | Path) -> Lens:
    """As :func:`load`; diameters that would take much memory stay in the file, as
    :class:`RowsOnDisk`.

    What looks at them in blocks of rows (the mask) needs no more; ``numpy.asarray``
    gives all of them.
    """
    large = False
    if Path(path).is_file():  # what else it is tells the loader, and what is damaged
        with contextlib.suppress(*store.DAMAGE):
            large = read_hdf5(path, _claimed) > MOST_HELD_BYTES
    if not large:
        return load(path)
    stored = store.load(path, "lens", without=(_NAME,))
    held = {**stored.arrays, _NAME: cast(Array, RowsOnDisk(path, _NAME))}
    return replace(
        lens_from_parts(held, stored.attributes, where=str(path)),
        provenance=stored.provenance,
    )


def _claimed(file: Any) -> int:
    """Bytes of the diameters."""
    return int(file[_NAME].nbytes)


def lens_to_parts(
    lens: Lens, *, group: str = ""
) -> tuple[dict[str, Array], dict[str, Any]]:
    """(arrays, attributes) of a lens for a store file; ``group`` stands before the
    names of the arrays.
    """
    arrays: dict[str, Array] = {f"{group}diameter_um": lens.diameters.diameter_um}
    about = (
        ("proxy", lens.proxy.to_arrays())
        if lens.pairs is None
        else ("pairs", lens.pairs.to_arrays())
    )
    arrays |= {f"{group}{about[0]}/{name}": array for name, array in about[1].items()}
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
        attributes |= {
            "lattice": config.dumps(d.lattice),
            "row_um": d.steps_um[1],
            "shape": lens.cell.shape.name,
        }
        attributes |= {"hand": lens.hand, "light": lens.light}
    if lens.neighbours is not None:
        arrays |= {
            f"{group}neighbours/{name}": array
            for name, array in lens.neighbours.to_arrays().items()
        }
    if d.angle_rad is not None:
        arrays |= {f"{group}angle_rad": d.angle_rad}
    if d.length_um is not None:
        arrays |= {f"{group}length_um": d.length_um}
    if lens.layers.films or lens.layers.stop is not None:
        attributes["layers"] = config.dumps(lens.layers)
    return arrays, attributes


def lens_from_parts(
    arrays: Mapping[str, Array],
    attributes: Mapping[str, Any],
    *,
    where: str,
    group: str = "",
) -> Lens:
    """Inverse of :func:`lens_to_parts`; ``where`` names the file in errors."""
    proxy, held, rows = (
        {
            name.removeprefix(start): array
            for name, array in arrays.items()
            if name.startswith(start)
        }
        for start in (f"{group}proxy/", f"{group}pairs/", f"{group}neighbours/")
    )
    pairs = TwoSizeTable.from_arrays(held) if held else None
    return Lens(
        diameters=_diameters(arrays, attributes, where, group),
        cell=config.loads(attributes["cell"], Cell, where=f"{where}: cell"),
        proxy=Proxy.from_arrays(proxy) if pairs is None else pairs.proxy,
        wavelength_um=attributes["wavelength_um"],
        sensor_distance_um=attributes["sensor_distance_um"],
        source_distance_um=attributes["source_distance_um"],
        profile=attributes["profile"],
        layers=_layers(attributes, where),
        hand=attributes.get("hand", ""),
        pairs=pairs,
        light=attributes.get("light", "x"),
        neighbours=NeighbourRows.from_arrays(rows) if rows else None,
    )


def _diameters(
    arrays: Mapping[str, Array], attributes: Mapping[str, Any], where: str, group: str
) -> DiameterMap:
    """The map of a file; on a square lattice in files that name none."""
    plain = DiameterMap(arrays[f"{group}diameter_um"], attributes["pitch_um"])
    if "lattice" not in attributes:
        return plain
    lattice = config.loads(attributes["lattice"], Lattice, where=f"{where}: lattice")
    row_um = 0.0 if lattice.kind == "square" else attributes["row_um"]
    turn, length = (arrays.get(f"{group}{name}") for name in ("angle_rad", "length_um"))
    return replace(
        plain, lattice=lattice, row_um=row_um, angle_rad=turn, length_um=length
    )


def _layers(attributes: Mapping[str, Any], where: str) -> Layers:
    """The films of a file; none in files that name none."""
    text = attributes.get("layers")
    return (
        Layers()
        if text is None
        else config.loads(text, Layers, where=f"{where}: layers")
    )
