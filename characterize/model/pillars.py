"""What a change of the pillars does to their transmission, as few functions of the
designed diameter.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.interpolate import CubicSpline

from characterize.model.parameters import PLACE, process_state_of
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import (
    PairTable,
    Perturbation,
    PillarKinds,
    RelativeResponse,
    ResponseError,
    Sensitivity,
    bias_ratio,
    designed_transmission,
    inapplicable_names,
    of_kind,
    perturbed_transmission,
    prepare_response,
    prior_scale,
    wavelength_scale,
)
from metalens.lens import DiameterMap, Lens
from metalens.library import Proxy

_ENTRIES = 20001  # half a step is 2e-4 rad of phase at most
_TOLERANCE = 3e-5  # rms error of t in the basis
_MISSED = 2e-3  # of t, at random changes: more bias nodes are laid above it
_ROOM = 1.07  # by which tables of pillars reach beyond the bounds of a fit
_ROWS = [row for _, row in of_kind(ResponseError)]


@dataclass(frozen=True, slots=True)
class PillarChange:
    """Change of the pillars that is the same all over the lens: the pillar-response errors in
    base units, and the wavelength.

    Zeros are the design.
    """

    response_amounts: tuple[float, ...] = (0.0,) * len(_ROWS)
    wavelength_um: float = 0.0


@dataclass(frozen=True, slots=True)
class ChangeRange:
    """Largest change of each kind that a low-rank basis must hold; beyond it the fit is
    refused.
    """

    bias_um: float
    response_amounts: tuple[float, ...]
    wavelength_um: float

    @classmethod
    def of(cls, lens: Lens) -> "ChangeRange":
        """The bounds of a fit and some room, without what the pillars cannot have.

        Lengths grow with the wavelength (:func:`wavelength_scale`).
        """
        more = wavelength_scale(lens.wavelength_um)
        absent = inapplicable_names(lens.cell)
        response_amounts = tuple(
            largest_amount(row, lens.wavelength_um) * (row.name not in absent)
            for row in _ROWS
        )
        return cls(0.03 * more, response_amounts, 0.006 * more)


def largest_amount(row: Perturbation, wavelength_um: float) -> float:
    """Largest amount of a pillar-response error that tables hold, in its base unit: the
    bounds of the fit and some room.

    Args:
        row: of the error.
        wavelength_um: of the design.
    """
    bound = max(-row.low, row.high) * prior_scale(row.name, wavelength_um)
    return _ROOM * row.unit * bound


class PillarResponse:
    """Transmission of pillars under change, exact and in a low-rank basis.

    basis: (r, grid) orthonormal functions on ``diameter_um`` (grid,). nodes_um: (b,)
    biases at which t is computed. error: largest |t - low-rank t| over random changes
    within the range, which the basis was not computed from.
    """

    _refinements: tuple[int, ...] = (
        1,
        2,
        3,
    )  # times the usual intervals between bias nodes that are tried

    def __init__(
        self, lens: Lens, response: Sensitivity, *, angle_rad: float = 0.0
    ) -> None:
        """Compute the basis, with more bias nodes until the error is below ``_MISSED``.

        Args:
            lens: its cell, proxy and diameters.
            response: slopes of ln t by the pillar-response errors.
            angle_rad: of incidence.
        """
        self.span = span = ChangeRange.of(lens)
        self.lens = lens
        self.response = response
        self.angle_rad = angle_rad
        self.diameter_um = self._grid_um()
        step_um = 0.006 * wavelength_scale(lens.wavelength_um)
        b = max(7, 2 * math.ceil(span.bias_um / step_um) + 1)
        for times in self._refinements:  # resonances need more nodes
            self._set_basis(times * (b - 1) + 1)
            self.error = self._measure()
            if self.error < _MISSED:
                break

    def _grid_um(self) -> Array:
        """(grid,) designed diameters that the functions are known at."""
        built = self.lens.diameters.diameter_um[self.lens.diameters.diameter_um > 0]
        return np.linspace(float(built.min()), float(built.max()) + 1e-9, 193)

    def _set_basis(self, count: int) -> None:
        """Set ``count`` bias nodes (Chebyshev) and the low-rank basis of t there.

        Left singular vectors of t over the training changes, to rms ``_TOLERANCE``.
        """
        unit = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        self.nodes_um = unit * self.span.bias_um
        share = np.where(np.arange(count) > 0, 2.0, 1.0) / count
        self._to_series = (chebyshev.chebvander(unit, count - 1) * share).T
        self._relative, self._bias_factor = self._relative_response(
            self.nodes_um[:, None]
        )
        columns = np.concatenate([self._at_nodes(p) for p in self._training()])
        u, size, _ = np.linalg.svd(columns.T, full_matrices=False)
        # rms of t outside the first functions
        tail = np.sqrt(
            np.cumsum(size[::-1] ** 2)[::-1] / len(columns) / len(self.diameter_um)
        )
        rank = max(1, int((tail > _TOLERANCE).sum()))
        self.basis = np.ascontiguousarray(u[:, :rank].T.conj())

    def _relative_response(
        self, nodes: Array
    ) -> tuple[RelativeResponse, Array | float]:
        """Response to the pillar-response errors, and factor of the bias, at (b, 1) nodes."""
        d = self.diameter_um + nodes
        return prepare_response(self.lens.proxy, self.response, d), bias_ratio(
            self.response, d, nodes
        )

    def exact(self, bias_um: Array | float, change: PillarChange) -> Array:
        """(..., grid) complex t at ``diameter_um`` + bias (a number, or (..., 1)) under
        a change.
        """
        d = self.diameter_um + bias_um
        wave = self.lens.wavelength_um + change.wavelength_um
        amounts = np.array(change.response_amounts)
        return perturbed_transmission(
            self.lens.proxy,
            self.response,
            d,
            wave,
            amounts,
            bias_um=bias_um,
            angle_rad=self.angle_rad,
        )

    def coefficients(self, change: PillarChange, lean_um: float = 0.0) -> Array:
        """(b, r) coefficients of t in the basis, as Chebyshev series of the bias.

        With leaning walls t is that of the mean of ln t over the height, by two Gauss
        points.

        Args:
            lean_um: diameter at the foot less that at half height, um; equal to that at
                half height less that at the top.
        """
        t = self._at_nodes(change)
        if lean_um:
            off = lean_um / math.sqrt(3)
            reach = max(self.span.bias_um - off, 0.0)
            bias = np.clip(self.nodes_um, -reach, reach)[:, None]
            low, middle, high = (
                self.exact(bias + step, PillarChange()) for step in (-off, 0.0, off)
            )
            t = t * np.sqrt(low * high / middle**2)
        return np.asarray(self._to_series @ (t @ self.basis.T))

    def _at_nodes(self, change: PillarChange) -> Array:
        """(b, grid) :meth:`exact` at the bias nodes: t as designed, times the factors of
        the pillar-response errors and of the bias.
        """
        designed = self._designed_at(self.lens.wavelength_um + change.wavelength_um)
        factor = self._relative.factor(np.array(change.response_amounts))
        return np.asarray(designed * factor * self._bias_factor)

    def _designed_at(self, wave_um: float) -> Array:
        """(b, grid) t as designed at the bias nodes, at ``wave_um``."""
        d = self.diameter_um + self.nodes_um[:, None]
        return designed_transmission(
            self.lens.proxy, d, wave_um, angle_rad=self.angle_rad
        )

    def table(self) -> Array:
        """(r, entries): the conjugate basis on a fine grid of diameters; the last entry
        is no pillar.
        """
        count = len(self.diameter_um)
        spline = CubicSpline(np.arange(count), self.basis.conj(), axis=1)
        rows = spline(np.linspace(0, count - 1, _ENTRIES))
        return np.concatenate([rows, np.zeros((len(rows), 1))], axis=1)

    def entries(self, diameters: DiameterMap, rows: slice, columns: slice) -> Array:
        """(y, x) entries of :meth:`table` nearest to the pillars of some rows and
        columns.
        """
        diameter_um = diameters.diameter_um[rows, columns]
        low, high = self.diameter_um[0], self.diameter_um[-1]
        entry = np.rint(
            (np.maximum(diameter_um, low) - low) * ((_ENTRIES - 1) / (high - low))
        ).astype(np.int32)
        return np.where(diameter_um > 0, entry, _ENTRIES)

    def weights(self, bias_um: Array) -> Array:
        """(b, *shape) Chebyshev polynomials of ``bias_um`` over the range, in its
        precision.
        """
        x = bias_um / self.span.bias_um
        values = chebyshev.chebvander(x, len(self.nodes_um) - 1)
        return np.moveaxis(values, -1, 0).reshape(-1, *x.shape)

    def _training(self) -> list[PillarChange]:
        """Changes that the basis is computed from: none, each extreme, random ones."""
        s = self.span
        waves = self._waves()
        single = np.diag([*s.response_amounts, s.wavelength_um])[
            : len(s.response_amounts) + waves
        ]
        extremes = [
            PillarChange(tuple(sign * change[:-1]), sign * change[-1])
            for change in single
            if change.any()
            for sign in (1, -1)
        ]
        random = (_draw(np.random.default_rng(i), s, waves) for i in range(6))
        return [PillarChange(), *extremes, *random]

    def _waves(self) -> bool:
        return bool(np.ptp(self.lens.proxy.wavelengths_um) > 0)

    def _measure(self) -> float:
        """Largest |t - low-rank t| over 40 random changes and biases within the range."""
        random = np.random.default_rng(99)
        worst = 0.0
        for _ in range(40):
            change = _draw(random, self.span, self._waves())
            bias = random.uniform(-0.7, 0.7) * self.span.bias_um
            c = self.weights(np.array(bias)) @ self.coefficients(change)
            difference = self.basis.conj().T @ c - self.exact(bias, change)
            worst = max(worst, float(np.abs(difference).max()))
        return worst


class PairedPillars(PillarResponse):
    """As :class:`PillarResponse`, for pillars of two sizes: one column for each pair.

    A bias moves all edges, so it adds to both sizes, along the table of the lens. The
    slopes by the pillar-response errors are those of the designed sizes. t is that of the
    design's wavelength, as the table has single ones.
    ``diameter_um``: width of each pair.
    """

    _refinements = 3, 6  # rectangles have more resonances than rounds

    def _grid_um(self) -> Array:
        pairs = self.response.pairs
        if pairs is None:
            raise FitError("pillars of two sizes: slopes of such pillars are needed")
        self._table, self._sizes = (
            PairTable.of(self.lens),
            PillarKinds.of(self.lens.diameters),
        )
        self._rates = pairs.at(self._sizes.width_um, self._sizes.length_um)
        return self._sizes.width_um

    def _relative_response(
        self, nodes: Array
    ) -> tuple[RelativeResponse, Array | float]:
        return RelativeResponse(self._rates[:, None], None, np.ones(1)), 1.0

    def exact(self, bias_um: Array | float, change: PillarChange) -> Array:
        """(..., kinds) complex t of both sizes + bias under a change."""
        t = self._table.t(
            self._sizes.width_um + bias_um, self._sizes.length_um + bias_um
        )
        return np.asarray(
            t * np.exp(np.tensordot(np.array(change.response_amounts), self._rates, 1))
        )

    def _designed_at(self, wave_um: float) -> Array:
        return self.exact(self.nodes_um[:, None], PillarChange())

    def _waves(self) -> bool:
        return False

    def table(self) -> Array:
        """(r, kinds + 1): the conjugate basis; the last entry is no pillar."""
        return np.concatenate(
            [self.basis.conj(), np.zeros((len(self.basis), 1))], axis=1
        )

    def entries(self, diameters: DiameterMap, rows: slice, columns: slice) -> Array:
        """(y, x) kinds of the pillars of some rows and columns."""
        return self._sizes.index(diameters, rows, columns)


def of_lens(
    lens: Lens, response: Sensitivity, *, angle_rad: float = 0.0
) -> PillarResponse:
    """The pillars of a lens, of one size or of two.

    Args:
        response: slopes of the pillars.
        angle_rad: angle of incidence or field angle, rad.
    """
    kind = PillarResponse if lens.pairs is None else PairedPillars
    return kind(lens, response, angle_rad=angle_rad)


def pillar_change_of(x: Array) -> PillarChange:
    """The pillars' change that the parameters mean.

    Args:
        x: all parameters, in the order of ``PARAMETERS``.
    """
    return PillarChange(
        tuple(process_state_of(x).response_amounts().tolist()),
        float(x[PLACE["wavelength_nm"]]) * 1e-3,
    )


def incidence_rad(proxy: Proxy, angle_rad: Iterable[float]) -> float:
    """Angle of incidence for a field angle (x, y): 0 where the proxy holds at normal
    incidence only.

    Args:
        angle_rad: angle of incidence or field angle, rad.
    """
    tilt = math.atan(math.hypot(*(math.tan(a) for a in angle_rad)))
    return tilt if proxy.max_angle_rad > 0 else 0.0


def _draw(random: np.random.Generator, span: ChangeRange, waves: bool) -> PillarChange:
    """Random change within 0.7 of the range; with a wavelength where ``waves``."""
    possible = np.flatnonzero(span.response_amounts)
    shares = random.uniform(-0.7, 0.7, len(possible) + 1)
    wave = shares[-1]
    amounts = np.zeros(len(span.response_amounts))
    amounts[possible] = shares[:-1] * np.array(span.response_amounts)[possible]
    return PillarChange(
        tuple(amounts.tolist()), float(wave) * span.wavelength_um * waves
    )
