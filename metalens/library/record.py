"""The pillar library: response over diameter, wavelength, angle and polarisation, an
error bar on every entry.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens.cell import Cell, Index, Polarization, check_subwavelength, index
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CellError, ConfigError, DomainError
from metalens.core.notebook import RecordView, own_axes
from metalens.core.store import Provenance, typed_reader
from metalens.library.geometric_phase import GeometricPhase, check_geometric_phase
from metalens.library.proxy import MOST_ERROR, Proxy

# Hydrogenated amorphous silicon deposited for near-infrared optics: n of 3.5-3.7 and
# hardly any loss. The evaporated
# film of Pierce and Spicer ("a-Si") absorbs so much that its pillars stay below |t| =
# 0.8 before half a turn.
PLAIN = Index(3.6)
DEFAULT_CELL = Cell(pitch_um=0.30, height_um=0.7, pillar=PLAIN)
# default tolerances: round pillars, others (corners converge slowly), two sizes
USUAL = {"modal": 1e-3, "rcwa": 0.02, "axes": 0.05}


@dataclass(frozen=True, slots=True)
class Sweep:
    """What a library holds.

    wavelengths_um: vacuum wavelengths.
    angles_deg: of incidence in air, in the plane of a lattice axis; both polarisations
        where one is not 0.
    diameters_um: (least, largest); without it from 0.06 (or a fifth of a smaller pitch)
        to the pitch less 0.05.
    samples: evenly spaced diameters.
    tolerance: error bar that is asked of every entry's t; left out, what the solver of
        such cells reaches but near resonances (:data:`USUAL`).
    engine: auto, rcwa or modal.
    lengths_um: (least, largest) size along y of a rectangle or an ellipse; diameters_um
        is then that along x, and the library one over both sizes (``samples`` entries
        along the longer range) with Jones matrices.
    light: linear, or circular: x and y at normal incidence, for pillars that are turned
        one by one; the proxy is then that of the light converted to the other hand.
    """

    wavelengths_um: tuple[float, ...] = (0.85,)
    angles_deg: tuple[float, ...] = (0.0,)
    diameters_um: tuple[float, float] | None = None
    samples: int = 200
    tolerance: float | None = None
    engine: str = "auto"
    light: Literal["linear", "circular"] = "linear"
    lengths_um: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        for name, values in (
            ("wavelengths_um", self.wavelengths_um),
            ("angles_deg", self.angles_deg),
        ):
            if not values or any(b <= a for a, b in itertools.pairwise(values)):
                raise ConfigError(
                    f"{name} = {list(values)}: need at least one value, rising"
                )
        if not all(math.isfinite(w) and w > 0 for w in self.wavelengths_um):
            raise ConfigError(
                f"wavelengths_um = {list(self.wavelengths_um)}: need finite lengths above 0"
            )
        if not all(0 <= a < 90 for a in self.angles_deg):
            raise ConfigError(
                f"angles_deg = {list(self.angles_deg)}: need 0 <= angle < 90"
            )
        if not 20 <= self.samples <= 100_000:
            raise ConfigError(f"samples = {self.samples}: need 20 to 100000")
        if self.tolerance is not None and not 1e-8 <= self.tolerance <= MOST_ERROR:
            raise ConfigError(
                f"tolerance = {self.tolerance}: need 1e-8 to {MOST_ERROR:g}"
            )
        if self.engine not in ("auto", "rcwa", "modal"):
            raise ConfigError(f"engine = {self.engine!r}: need auto, rcwa or modal")
        if self.light == "circular" and self.angles_deg != (0.0,):
            raise ConfigError(
                f"angles_deg = {list(self.angles_deg)} of circular light: need normal incidence, [0.0]"
            )
        if self.lengths_um is not None:
            self._check_lengths(self.lengths_um)

    def _check_lengths(
        self, lengths: tuple[float, float], most_samples: int = 1000
    ) -> None:
        """Refuse ranges of two sizes, and settings that do not apply to them.

        Args:
            lengths: (least, largest) size along y, um.
            most_samples: along a size: a million Jones matrices per wavelength.

        Raises:
            ConfigError: naming the setting.
        """
        for name, span in (
            ("diameters_um", self.diameters_um or (0, 0)),
            ("lengths_um", lengths),
        ):
            if not (0 < span[0] < span[1] and math.isfinite(span[1])):
                raise ConfigError(
                    f"{name} = {list(span)}: with lengths_um both need 0 < least < largest"
                )
        supported = (
            self.angles_deg == (0.0,)
            and self.light == "linear"
            and self.engine != "modal"
        )
        if not supported or self.samples > most_samples:
            raise ConfigError(
                f"lengths_um = {list(lengths)}: a library over two sizes is for normal incidence (angles_deg = [0.0]), "
                f'light = "linear", engine auto or rcwa, and at most {most_samples} samples'
            )

    @property
    def polarizations(self) -> tuple[Polarization, ...]:
        """Polarisations that are solved: x at normal incidence (a square lattice
        responds equally to x and y), else s and p; x and y for circular light.
        """
        if self.light == "circular":
            return ("x", "y")
        return ("x",) if self.angles_deg == (0.0,) else ("s", "p")

    @property
    def bar(self) -> float:
        """The tolerance of t, or that of round pillars where none is stated."""
        return USUAL["modal"] if self.tolerance is None else self.tolerance

    def with_tolerance(self, cell: Cell) -> "Sweep":
        """The settings with the default tolerance of such a cell filled in where none
        is stated.
        """
        if self.tolerance is not None:
            return self
        kind = "modal" if cell.round else "rcwa"
        if self.lengths_um is not None:
            kind = "axes"
        return dataclasses.replace(self, tolerance=USUAL[kind])

    def span_um(self, cell: Cell, edge_gap_um: float = 0.05) -> tuple[float, float]:
        """(least, largest) diameter of the sweep, um; the default range where none is
        stated.

        Args:
            cell: unit cell with its materials, shape and lattice.
            edge_gap_um: least gap of the default range: a printable gap of 60 nm, less
                10 nm of bias.

        Raises:
            CellError: the diameters do not fit into the cell.
        """
        thinnest = max(min(0.06, cell.pitch_um / 5), cell.size_um(0.0))
        low, high = self.diameters_um or (thinnest, cell.widest_um(edge_gap_um))
        if not 0 < low < high:
            raise CellError(
                f"diameters_um = ({low:g}, {high:g}): need 0 < least < largest"
            )
        if high >= cell.pitch_um if cell.round else cell.gap_um(high) <= 0:
            raise CellError(
                f"diameters_um reaches {high:g} um on a pitch of {cell.pitch_um:g} um: pillars touch; "
                "keep the largest diameter below the pitch"
            )
        return low, high


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class PillarLibrary(RecordView):
    """Response of one pillar cell; see :class:`metalens.cell.response.Response` for the
    normalisation.

    cell, sweep: what was computed.
    polarization: names along the first axis; angle_rad, wavelength_um, diameter_um: the
        other axes.
    t, r: (polarization, angle, wavelength, diameter) complex amplitudes of the zero
        order.
    t_error: as t; estimate of |t - exact|, not below the true error.
    energy: as t; |t|² + |r|² of the zero orders, 1 where nothing absorbs and no other
        order propagates.
    resonances: (k, 5) polarization index, angle_rad, wavelength_um, diameter_um,
        half-width in um of the poles of t(D) near the real axis.
    engine: modal or rcwa. solves: exact solves behind the entries.
    proxy: polynomial of Eq. 2 fitted to the entries; notes: what was cut from its
        domain, and why.
    turned: for circular light, the pillar of most conversion solved at several turns.
    """

    cell: Cell
    sweep: Sweep
    polarization: tuple[str, ...]
    angle_rad: Array
    wavelength_um: Array
    diameter_um: Array
    t: Array
    r: Array
    t_error: Array
    energy: Array
    resonances: Array
    engine: str
    solves: int
    proxy: Proxy | None = None
    notes: tuple[str, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)
    turned: GeometricPhase | None = None

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together, and values that are not finite."""
        shape = (
            len(self.polarization),
            len(self.angle_rad),
            len(self.wavelength_um),
            len(self.diameter_um),
        )
        for name in ("t", "r", "t_error", "energy"):
            if getattr(self, name).shape != shape:
                raise DomainError(
                    f"library {name} has shape {getattr(self, name).shape}, need {shape}"
                )
            if not np.isfinite(getattr(self, name)).all():
                raise DomainError(f"library {name} holds values that are not finite")

    def plot(self, ax: Any = None) -> Any:
        """Draw |t|² and the phase in turns over the size; returns the axes.

        Args:
            ax: matplotlib axes; those of a new figure where none are given.
        """
        axes = own_axes(ax)
        t = self.t[0, 0, 0]
        phase = np.unwrap(np.angle(t)) / (2 * np.pi)
        axes.plot(self.diameter_um, phase - phase.min(), label="phase / turns")
        axes.plot(self.diameter_um, np.abs(t) ** 2, label="|t|²")
        axes.set(xlabel="size / µm")
        axes.legend()
        return axes

    def to_xarray(self) -> Any:
        """xarray.Dataset of t, r, t_error and energy over (polarization, angle_rad,
        wavelength_um, diameter_um).
        """
        import xarray

        names = ("polarization", "angle_rad", "wavelength_um", "diameter_um")
        values = ("t", "r", "t_error", "energy")
        return xarray.Dataset(
            {name: (names, getattr(self, name)) for name in values},
            {name: np.array(getattr(self, name)) for name in names},
            {"pitch_um": self.cell.pitch_um, "height_um": self.cell.height_um},
        )

    @property
    def converged(self) -> bool:
        """Whether every error bar meets the tolerance."""
        return bool(self.t_error.max() <= self.sweep.bar)

    @property
    def lost(self) -> Array:
        """Share of the power outside the zero order of the incident polarisation, as t:
        it is absorbed, or in other orders or the other polarisation.
        """
        return np.asarray(np.maximum(1 - self.energy, 0.0))

    @property
    def cross_polarized(self) -> Array:
        """(wavelength, size) amplitude (t_x - t_y)/2 that circular light sends to the
        other hand, for pillars that are not turned.
        """
        return np.asarray(self.t[0, 0] - self.t[1, 0]) / 2

    @property
    def best_converting_um(self) -> float:
        """Size whose least conversion over the wavelengths is largest, um; only sizes
        whose bars meet the tolerance, if there are any.
        """
        conversion = np.abs(self.cross_polarized).min(axis=0)
        accurate = (self.t_error <= self.sweep.bar).all(axis=(0, 1, 2))
        place = int(np.where(accurate | ~accurate.any(), conversion, -1.0).argmax())
        return float(self.diameter_um[place])

    def mean_loss(self, diameter_um: Array, wavelength_um: float) -> float:
        """Mean of :attr:`lost` over pillars, at the least angle of the library.

        Args:
            diameter_um: of the pillars, um; 0 where there is none.
            wavelength_um: the closest one of the library is taken; polarisations are
                averaged.
        """
        nearest = int(np.argmin(np.abs(self.wavelength_um - wavelength_um)))
        pillars = np.ravel(diameter_um)[np.ravel(diameter_um) > 0]
        loss = self.lost[:, 0, nearest].mean(axis=0)
        return float(np.interp(pillars, self.diameter_um, loss).mean())


def check_sweep(cell: Cell, sweep: Sweep) -> None:
    """Refuse a sweep that cannot be computed.

    Args:
        cell: unit cell with its materials, shape and lattice.
        sweep: settings of the library.

    Raises:
        CellError: pillars touch, or diffraction orders propagate in the cover (named).
        MaterialError: a wavelength outside the range of a material.
    """
    span = sweep.span_um(cell)
    if sweep.lengths_um is not None:
        raise ConfigError(
            "lengths_um: a library over two sizes comes from metalens.library.axes.sweep_two_sizes"
        )
    if sweep.light == "circular":
        check_geometric_phase(cell, span[1])
    check_light(cell, sweep)


def check_light(cell: Cell, sweep: Sweep) -> None:
    """Refuse wavelengths that a material does not hold, half-spaces that absorb, and
    diffraction orders that propagate in the cover.

    Args:
        cell: unit cell with its materials, shape and lattice.
        sweep: settings of the library.

    Raises:
        CellError, MaterialError: as :func:`check_sweep`.
    """
    for wavelength in sweep.wavelengths_um:
        for material in cell.materials:
            index(material, wavelength)
        for side in ("substrate", "cover"):
            n = index(getattr(cell, side), wavelength)
            if n.imag:
                raise CellError(
                    f"{side} absorbs at {wavelength:g} um (n = {n:.4g}): the power that enters or leaves it depends on "
                    "where it is measured; give its real index, or make the absorbing part a film under or over"
                )
        check_subwavelength(
            cell, wavelength, angle_rad=math.radians(sweep.angles_deg[-1])
        )


def save(path: str | Path, library: PillarLibrary) -> None:
    """Write a library file (kind ``library``).

    Args:
        path: target, replaced atomically.
    """
    store.save_record(path, "library", library)


@typed_reader
def load(path: str | Path) -> PillarLibrary:
    """Read a library file.

    Args:
        path: of the file.

    Raises:
        StoreError: not a library file; DomainError: its arrays do not fit together.
    """
    return store.load_record(path, "library", PillarLibrary)
