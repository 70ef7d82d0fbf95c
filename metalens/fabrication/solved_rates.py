"""Rates of pillars by central differences of RCWA, and tables of two sizes."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RBFInterpolator, RectBivariateSpline

from metalens.cell import Cell
from metalens.core import executor
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.fabrication.perturbations import (
    LEAST_TRANSMISSION,
    changed_pillar,
    response_errors,
    with_missing,
)
from metalens.lens import DiameterMap, Lens
from metalens.library.axes import cell_of_sizes

_ENTRY_UM = 5e-5  # resolution of sizes; equal rounded sizes are one kind
_TRUNCATIONS = (6, 8)  # harmonics of the coarser and the finer solution
_STEP = 1e-3  # um, rad or 1 of a number of the pillar, to either side
_WALL_STEP_RAD = 5e-3  # 0.7 um of height then moves foot and top by 3.5 nm
_ALONG_X, _ALONG_Y = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])


@dataclass(frozen=True, eq=False, slots=True)
class ResponseRates:
    """Logarithmic derivatives of t at solved sizes, and between these by radial
    functions |r - r_j| (linear interpolation, where pillars have one size).

    Beyond the sizes of pillars of one size, the end value holds.

    sizes_um: (n, k) solved sizes, k = 1 or 2 (along x and along y) a pillar.
    rates: (pillar-response errors, n) complex, by the base unit of each (um, rad, 1); 0
        for errors that such pillars cannot have. Rows that are missing are 0.
    error: largest relative change (rms over the sizes) of one of them from a coarser
        truncation, with that of the interpolation of two sizes.
    edges: (n,) by a bias of all edges less that by the size, per um; 0 where a shape
        keeps its form as its edges move (circles, squares), and for two sizes.
    """

    sizes_um: Array
    rates: Array
    error: float
    edges: Array

    def at(self, *sizes_um: Array) -> Array:
        """(pillar-response errors, *shape) derivatives of ln t.

        Args:
            sizes_um: (*shape) one array of sizes, or those along x and along y, um.
        """
        return with_missing(self._interpolate(self.rates, sizes_um))

    def by_edges(self, size_um: Array) -> Array | None:
        """(*shape) change of ln t per um of a bias of all edges, beyond that of the
        size; None where that is nothing.
        """
        if not self.edges.any():
            return None
        return np.asarray(self._interpolate(self.edges[None], (size_um,))[0])

    def _interpolate(self, rows: Array, sizes_um: tuple[Array, ...]) -> Array:
        """(rows, *shape) values at sizes, from (rows, n) at the solved sizes."""
        places = np.stack(sizes_um, axis=-1)
        between = RBFInterpolator(self.sizes_um, rows.T, kernel="linear", degree=0)
        values = between(places.reshape(-1, len(sizes_um)))
        return np.asarray(values.T.reshape(len(rows), *places.shape[:-1]))


def own_rates(lens: Lens, size_um: Array) -> ResponseRates:
    """Derivatives of ln t of a lens's pillars by every pillar-response error.

    Central differences of RCWA, for the light of the lens's proxy.

    Args:
        lens: with pillars of one size.
        size_um: (n,) sizes of pillars.

    Accuracy: ``error``, the change from a coarser truncation: a few percent.

    Raises:
        CellError, MaterialError: from the solver.
        LensError: pillars of two sizes (:func:`pair_rates`).
    """
    if lens.pairs is not None:
        raise LensError(
            "pillars of two sizes: their derivatives are no function of one size"
        )
    edges = (
        {} if lens.cell.shape.kind == "circle" else {"grow_um": 1.0, "size_um": -1.0}
    )
    (rates,) = _rates(
        lens,
        [(lens.cell, float(d)) for d in size_um],
        edges,
        (polarization_weights(lens),),
    )
    return rates


def pair_rates(
    lens: Lens, width_um: Array, length_um: Array
) -> dict[str, ResponseRates]:
    """As :func:`own_rates`, of pillars of two sizes, for light along "x" and along "y".

    Their table knows both sizes, so that nothing is left of a bias of all edges:
    ``edges`` are 0.

    Args:
        lens: the lens.
        width_um: (n,) sizes along x, um.
        length_um: (n,) sizes along y, um.
    """
    cells = [
        (cell_of_sizes(lens.cell, float(w), float(d)), float(w))
        for w, d in zip(width_um, length_um, strict=True)
    ]
    sizes = np.stack([width_um, length_um], axis=1)
    solved = _rates(lens, cells, {}, (_ALONG_X, _ALONG_Y))
    return {
        light: replace(rates, sizes_um=sizes)
        for light, rates in zip("xy", solved, strict=True)
    }


def _rates(
    lens: Lens,
    cells: list[tuple[Cell, float]],
    edges: dict[str, float],
    weights: tuple[Array, ...],
) -> list[ResponseRates]:
    """Rates of pillars, one :class:`ResponseRates` for each weighting of the Jones matrix.

    Args:
        lens: the lens.
        cells: cell and size of each pillar.
        edges: rates of the cell's numbers by a bias of edges less that by the size.
        weights: (2, 2) weightings of the Jones matrix.
    """
    tasks = [(cell, size, order) for order in _TRUNCATIONS for cell, size in cells]
    common = (lens.wavelength_um, edges, weights)
    slopes = np.array(list(executor.gather_parallel(_log_slopes, common, tasks)))
    # (truncations, cells, weights, causes) to (weights, truncations, causes, cells)
    slopes = slopes.reshape(len(_TRUNCATIONS), len(cells), len(weights), -1)
    sizes = np.array([size for _, size in cells])[:, None]
    return [
        _with_error(sizes, coarse, fine)
        for coarse, fine in slopes.transpose(2, 0, 3, 1)
    ]


def _with_error(sizes_um: Array, coarse: Array, fine: Array) -> ResponseRates:
    """Rates of the finer truncation, with the largest relative change from the coarser.

    Args:
        sizes_um: (n, 1) sizes.
        coarse, fine: (causes + 1, n) rates, the last row by the edges.
    """
    edges = fine[-1] * (np.abs(fine[-1]).max() > 1e-6 * np.abs(fine).max())
    return ResponseRates(sizes_um, fine[:-1], largest_row_error(coarse, fine), edges)


def largest_row_error(estimate: Array, rows: Array) -> float:
    """Largest relative error, rms over a row, of an ``estimate`` of ``rows``, both
    (causes, n).
    """
    norm = np.linalg.norm(rows, axis=1)
    # rates that a mirror of the cell forbids (a turn) are rounding errors
    nonzero = norm > 1e-6 * norm.max()
    error = np.linalg.norm(estimate - rows, axis=1)[nonzero] / norm[nonzero]
    return float(error.max(initial=0.0))


def polarization_weights(lens: Lens) -> Array:
    """(2, 2) weights of the Jones matrix whose weighted sum is the t of the proxy.

    The geometric phase is left out. Circular light: outer product of (1, ±i) / √2;
    light
    along x alone: xx; otherwise the mean of xx and yy.

    Args:
        lens: the lens.
    """
    if lens.hand:
        incident = np.array([1.0, 1j if lens.hand == "right" else -1j]) / np.sqrt(2)
        return np.outer(incident, incident)
    along_x = lens.one_light and lens.proxy.max_angle_rad == 0
    return _ALONG_X if along_x else (_ALONG_X + _ALONG_Y) / 2


def _log_slopes(
    about: tuple[float, dict[str, float], tuple[Array, ...]],
    task: tuple[Cell, float, int],
) -> list[list[complex]]:
    """Derivatives of ln t of one pillar at one truncation, for each weighting.

    Args:
        about: wavelength in um, rates of the edges, weightings of the Jones matrix.
        task: cell, size in um, harmonics.

    Returns:
        Of each weighting a row: every pillar-response error, last the edges.
    """
    (wavelength_um, edges, weights), (cell, size_um, _harmonics) = about, task
    changes = [acts.numbers(cell, size_um) for _, acts in response_errors()]
    slopes = [
        _slopes(numbers, wavelength_um, weights, task) for numbers in (*changes, edges)
    ]
    return [list(each) for each in zip(*slopes, strict=True)]


def _slopes(
    numbers: dict[str, float],
    wavelength_um: float,
    weights: tuple[Array, ...],
    task: tuple[Cell, float, int],
) -> list[complex]:
    """Central difference of ln t as a pillar's numbers change, for each weighting.

    (ln t(+h) - ln t(-h)) / 2h with t = sum(weights × Jones matrix); 0 without numbers.

    Args:
        numbers: rate of each number of the cell.
        wavelength_um: vacuum wavelength, um.
        weights: (2, 2) weightings of the Jones matrix.
        task: cell, size in um, harmonics.
    """
    from metalens.rcwa import solve_truncation

    cell, size_um, harmonics = task
    if not numbers:
        return [0j] * len(weights)
    tilted = "sidewall_rad" in numbers
    step = _WALL_STEP_RAD if tilted else _STEP
    less, middle, more = (
        changed_pillar(cell, size_um, numbers, amount, wavelength_um)
        for amount in (-step, 1e-6 * step, step)
    )
    t_less, t_more = (
        solve_truncation(
            *end,
            wavelength_um,
            harmonics=harmonics,
            normals_of=None if tilted else middle,  # normals move with a tilted wall
            tolerance=1e-3,  # of a wall: 1e-4, which changes rates by some 1e-3
        ).t
        for end in (less, more)
    )
    return [
        complex(np.log((w * t_more).sum() / (w * t_less).sum()) / (2 * step))
        for w in weights
    ]


@dataclass(frozen=True, eq=False, slots=True)
class PairTable:
    """t over both sizes for one light: cubic splines of Re t and Im t, and from the
    table's ends on along its tangents.

    x_um, y_um: sizes of the table. parts: splines of both parts.
    """

    x_um: Array
    y_um: Array
    parts: tuple[RectBivariateSpline, RectBivariateSpline]

    @classmethod
    def of(cls, lens: Lens) -> "PairTable":
        """Splines of a lens's table, for its light at its wavelength.

        Raises:
            LensError: a lens whose pillars have one size.
        """
        pairs = lens.pairs
        if pairs is None:
            raise LensError(
                "the pillars have one size each: their t is that of the proxy"
            )
        x, y = pairs.x_um, pairs.y_um
        t = pairs.amplitude(
            *np.meshgrid(x, y, indexing="ij"), lens.wavelength_um, lens.light
        )
        degree = {"kx": min(3, len(x) - 1), "ky": min(3, len(y) - 1)}
        return cls(
            x,
            y,
            (
                RectBivariateSpline(x, y, t.real, **degree),
                RectBivariateSpline(x, y, t.imag, **degree),
            ),
        )

    def t(self, width_um: Array, length_um: Array) -> Array:
        """(*shape) complex t at sizes; beyond the table |t| and phase continue along
        tangents.

        |t| = |t_end| + Re(change conj(t_end)) / |t_end|, phase = arg t_end + Im(change
        / t_end), with change = dx ∂t/∂x + dy ∂t/∂y. |t| stays within 1e-3 to 1.

        Args:
            width_um: (*shape) sizes along x, um.
            length_um: (*shape) sizes along y, um.
        """
        x = np.clip(width_um, self.x_um[0], self.x_um[-1])
        y = np.clip(length_um, self.y_um[0], self.y_um[-1])
        value = self._spline(x, y)
        if (x == width_um).all() and (y == length_um).all():
            return value
        by_width = (width_um - x) * self._spline(x, y, dx=1)
        change = by_width + (length_um - y) * self._spline(x, y, dy=1)
        level = np.abs(value) + (change * value.conj()).real / np.abs(value)
        phase = np.angle(value) + (change / value).imag
        return np.asarray(np.clip(level, LEAST_TRANSMISSION, 1.0) * np.exp(1j * phase))

    def _spline(self, x_um: Array, y_um: Array, *, dx: int = 0, dy: int = 0) -> Array:
        """(*shape) complex t, or its derivative of order dx, dy, from both splines."""
        real, imaginary = (part.ev(x_um, y_um, dx=dx, dy=dy) for part in self.parts)
        return np.asarray(real + 1j * imaginary)


@dataclass(frozen=True, eq=False, slots=True)
class PillarKinds:
    """The kinds of pillars that a lens has: (kinds,) width_um, length_um and count of
    each, rising.

    keys: (kinds,) by which :meth:`index` knows them.
    """

    width_um: Array
    length_um: Array
    count: Array
    keys: Array

    @classmethod
    def of(cls, diameters: DiameterMap) -> "PillarKinds":
        """Of a map; pillars of one size have a length of 0."""
        all_sites = _keys(diameters, slice(None), slice(None))
        used, count = np.unique(all_sites, return_counts=True)
        empty = int(used[0] == 0)  # 1 where some site holds no pillar
        keys = used[empty:]
        return cls(
            (keys >> 32) * _ENTRY_UM,
            (keys & 0xFFFFFFFF) * _ENTRY_UM,
            count[empty:],
            keys,
        )

    def index(
        self,
        diameters: DiameterMap,
        rows: slice = slice(None),
        columns: slice = slice(None),
    ) -> Array:
        """(y, x) int32 kind of each site, from 0; the number of kinds where no pillar
        stands.

        Args:
            diameters: map of pillars of these kinds.
            rows: of the map.
            columns: of the map.
        """
        keys = _keys(diameters, rows, columns)
        return np.where(
            keys > 0, np.searchsorted(self.keys, keys), len(self.keys)
        ).astype(np.int32)


def _keys(diameters: DiameterMap, rows: slice, columns: slice) -> Array:
    """(y, x) integer key of both sizes of every site, in steps of 0.05 nm; 0 for no
    pillar.

    The width is in the upper 32 bits, the length in the lower (0 for one size).

    Args:
        diameters: map of the pillars.
        rows: of the map.
        columns: of the map.
    """
    width = np.rint(
        np.asarray(diameters.diameter_um[rows])[:, columns] / _ENTRY_UM
    ).astype(np.int64)
    size = diameters.length_um
    length = (
        0
        if size is None
        else np.rint(np.asarray(size[rows])[:, columns] / _ENTRY_UM).astype(np.int64)
    )
    return np.where(width > 0, (width << 32) + length, 0)


def pair_sensitivities(lens: Lens, *, count: int = 24) -> dict[str, ResponseRates]:
    """Derivatives of ln t at size pairs of the lens, for light along "x" and along "y".

    Up to ``count`` pairs far from one another are solved by RCWA, by central
    differences at a fixed truncation. Between the pairs: radial functions |r - r_j| of
    both sizes.

    Args:
        lens: of pillars of two sizes.
        count: most pairs that are solved.

    Raises:
        CellError, MaterialError: from the solver.
    """
    kinds = PillarKinds.of(lens.diameters)
    pairs = np.stack([kinds.width_um, kinds.length_um], 1)
    width, length = pairs[_farthest_points(pairs, int(kinds.count.argmax()), count)].T
    solved = pair_rates(lens, width, length)
    return {
        light: replace(rates, error=rates.error + _held_out_error(rates))
        for light, rates in solved.items()
    }


def _farthest_points(points: Array, first: int, count: int) -> list[int]:
    """Indices of a farthest-point sample: each next point is farthest from all before
    it.

    Args:
        points: (n, 2) points.
        first: index of the first.
        count: most points.
    """
    chosen = [first]
    distance = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(
            distance, np.linalg.norm(points - points[chosen[-1]], axis=1)
        )
    return chosen


def _held_out_error(solved: ResponseRates) -> float:
    """Largest relative rms error over causes of rates predicted at held-out pairs.

    The second half of the pairs is predicted from the first half.

    Args:
        solved: (n,) pairs of sizes.
    """
    sizes, rates = solved.sizes_um, solved.rates
    half = (len(sizes) + 1) // 2
    if half == len(sizes):
        return 0.0
    first = replace(solved, sizes_um=sizes[:half], rates=rates[:, :half])
    predicted = first.at(*sizes[half:].T)[: len(rates)]
    return largest_row_error(predicted, rates[:, half:])
