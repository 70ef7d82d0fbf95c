"""The lens that is handed on: a diameter map, and what is needed to know its phase at
any wavelength.
"""

import contextlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from metalens.cell import Cell
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.core.store import Provenance, typed_reader
from metalens.lens.diameters import DiameterMap as DiameterMap
from metalens.lens.neighbours import NeighbourRows
from metalens.lens.pairs import TwoSizeTable
from metalens.library import Proxy
from metalens.optics.aperture_stop import Stop as Stop
from metalens.optics.layers import Layers as Layers
from metalens.optics.layers import check_gaps

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
        grows by twice the turn of a pillar) or "left"; the proxy is then that of the
        light that leaves with the other hand. Empty: any light.
    pairs: table of pillars of two sizes in place of the proxy; None where they have
        one. light: polarisation, "x" or "y", that phase, transmission and distances are
        for where they have two (:meth:`seen`).
    neighbours: rows of its own unlike pillars (:func:`metalens.design.neighbours`),
        whose factor PSFs and images then hold; None where none was solved.

    Raises:
        LensError: layers with another cover than the cell's; turned pillars without a
            hand, or the other way round; PropagationError: films thicker than their
            gap.
    """

    diameters: DiameterMap = field(metadata={"flat": True})
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
    """Write a lens file (kind ``lens``); diameters keep their dtype.

    Args:
        path: target, replaced atomically.
    """
    store.save_record(path, "lens", lens)


@typed_reader
def load(path: str | Path) -> Lens:
    """Read a lens file.

    Args:
        path: of the file.

    Raises:
        StoreError: not a lens file; LensError: its diameters are invalid.
    """
    return store.load_record(path, "lens", Lens)


@typed_reader
def load_plain(path: str | Path) -> Lens:
    """As :func:`load`, for what knows only round or fixed pillars on a square lattice.

    Args:
        path: of the file.

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
    """As :func:`load`; diameters that would take much memory stay in the file.

    ``diameters.diameter_um`` is then an HDF5 data set: blocks of its rows are arrays,
    ``numpy.asarray`` reads all of it.

    Args:
        path: of the file.
    """
    large = False
    if Path(path).is_file():  # what else it is tells the loader, and what is damaged
        with contextlib.suppress(*store.DAMAGE), h5py.File(path, "r") as file:
            large = file[_NAME].nbytes > MOST_HELD_BYTES
    if not large:
        return load(path)
    stored = store.load(path, "lens", without=(_NAME,))
    file = h5py.File(path, "r", rdcc_nbytes=MOST_HELD_BYTES)
    arrays = {**stored.arrays, _NAME: file[_NAME]}
    return store.build_record(
        Lens, arrays, stored.attributes, where=str(path), provenance=stored.provenance
    )
