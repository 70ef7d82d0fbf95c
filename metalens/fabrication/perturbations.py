"""Fabrication perturbations of a lens: one table with unit, prior, bounds, derivative,
symmetry and measurement of each.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from metalens.cell import Cell, Index, index
from metalens.cell.shapes import Ellipse, Rectangle
from metalens.core.arrays import Array
from metalens.core.units import deg

Terms = tuple[tuple[float, int, int], ...]  # (c, i, j): c u^i v^j
LEAST_TRANSMISSION = 1e-3  # of |t| that is extrapolated along a tangent


@dataclass(frozen=True, slots=True)
class WaveguideModel:
    """Pillars as single-mode waveguides over their diameters, for the quick
    derivatives.

    k: wavenumber in vacuum, rad/um. diameter_um: (n,). effective: (n,) effective index.
    slope, curvature: (n,) its first and second derivative by the diameter. index,
    around: refractive index of the pillar and of its surroundings. height_um,
    sidewall_rad: of the design.
    """

    k: float
    diameter_um: Array
    effective: Array
    slope: Array
    curvature: Array
    index: float
    around: float
    height_um: float
    sidewall_rad: float


@dataclass(frozen=True, slots=True)
class CDError:
    """Derivative of the diameter: um a unit of the cause, a polynomial in (u, v)."""

    terms: Terms


@dataclass(frozen=True, slots=True)
class ResponseError:
    """Derivative of ln t of every pillar, by ``unit`` of the row.

    quick: from the effective index, (n,) complex for the diameters of a guide.
    numbers: rate of each number of a cell, as
        :func:`metalens.fabrication.changed_pillar` names them, by cell and size of the
        pillar; {} where such a pillar cannot have the perturbation.
    exact: the number of the cell that tables of t follow by powers
        (:class:`metalens.fabrication.SolvedResponse`), empty where none does.
    """

    quick: Callable[[WaveguideModel], Array]
    numbers: Callable[[Cell, float], dict[str, float]]
    exact: Literal["height_um", "n", ""] = ""


@dataclass(frozen=True, slots=True)
class WavefrontError:
    """Derivative of the wave front's phase: rad a unit of the cause, a polynomial in
    (u, v).
    """

    terms: Terms


Kind = type[CDError] | type[ResponseError] | type[WavefrontError]


@dataclass(frozen=True, slots=True)
class DrawnPerturbation:
    """How a process spreads a cause, by its entry in PROCESS.toml's table ``spread``.

    name, sigma: entry and its default standard deviation. share: factor of the entry's
        amount for this cause; two causes of one entry are the x and y component of a
        direction that is random for every lens.
    """

    name: str
    sigma: float
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Perturbation:
    """One row: a number that says how a fabricated lens differs from its design; 0 is the
    design.

    meaning: for reports. scale: a typical uncertainty, for steps and plots. sigma:
        prior knowledge without metrology.
    low, high: bounds. acts: its derivative. unit: um, rad or 1 in one unit of the name.
    free: fitted unless stated otherwise. drawn: how the process spreads it, where it
        does. plausible: standard deviation that is assumed where it is neither
        fitted nor stated; sigma where 0. effect: as a cause in words, where it is
        looked for while it is not fitted; probe: so much of it is tried then.
    reversible: near focus the images of a lens with the opposite sign look equal.
    measured_by: what measures it besides the frames.
    """

    name: str
    meaning: str
    scale: float
    sigma: float
    low: float
    high: float
    acts: CDError | ResponseError | WavefrontError
    unit: float = 1.0
    free: bool = True
    drawn: DrawnPerturbation | None = None
    plausible: float = 0.0
    effect: str = ""
    probe: float = 0.0
    reversible: bool = False
    measured_by: str = ""


def _height_rate(g: WaveguideModel) -> Array:
    """d ln t / d height of pillars, per um: i k n_eff."""
    return 1j * g.k * g.effective


def _index_rate(g: WaveguideModel) -> Array:
    """d ln t / d n of pillars: i k h (b n + n D b' / 2) / n_eff.

    b = (n_eff² - n_0²) / (n² - n_0²), with n_0 of the surroundings, is a function of
    D sqrt(n² - n_0²).
    """
    contrast = g.index**2 - g.around**2
    b = (g.effective**2 - g.around**2) / contrast
    db_dd = 2 * g.effective * g.slope / contrast
    bracket = b * g.index + g.index * g.diameter_um * db_dd / 2
    return 1j * g.k * g.height_um * bracket / g.effective


def _sidewall_rate(g: WaveguideModel) -> Array:
    """d ln t / d sidewall angle of pillars, per rad: i k n_eff'' s h³ / 3.

    The diameter is that at half height, so that the wall acts in second order.
    """
    return 1j * g.k * g.curvature * g.sidewall_rad * g.height_um**3 / 3


def _side_rate(g: WaveguideModel) -> Array:
    """d ln t / d width or length of pillars, per um: i k h n_eff' / 2.

    The mean over both polarisations is half of the diameter's derivative.
    """
    return 0.5j * g.k * g.height_um * g.slope


def _zero_rate(g: WaveguideModel) -> Array:
    """Zeros: round pillars without films do not depend on a turn or on films."""
    return np.zeros_like(g.effective, complex)


def _cell_number(name: str) -> Callable[[Cell, float], dict[str, float]]:
    """Rates of a cell's numbers by this one alone, which every cell has."""
    return lambda cell, size_um: {name: 1.0}


def _width_numbers(cell: Cell, size_um: float) -> dict[str, float]:
    """Rates of a cell's numbers by its width: the size grows and the length stays.

    L = ratio × size, so that the ratio changes by -ratio / size; {} for shapes of one
    size.
    """
    ratio = _ratio(cell)
    return {"size_um": 1.0, "shape.ratio": -ratio / size_um} if ratio else {}


def _length_numbers(cell: Cell, size_um: float) -> dict[str, float]:
    """Rates of a cell's numbers by its length; {} for shapes of one size."""
    return {"shape.ratio": 1 / size_um} if _ratio(cell) else {}


def _turn_numbers(cell: Cell, size_um: float) -> dict[str, float]:
    """Rates of a cell's numbers by a turn of the pillar, {} for round ones."""
    return {"shape.angle_rad": 1.0} if hasattr(cell.shape, "angle_rad") else {}


def _ratio(cell: Cell) -> float:
    """Length over size of a rectangle or an ellipse; 0 for other shapes."""
    return (
        float(cell.shape.ratio) if isinstance(cell.shape, Rectangle | Ellipse) else 0.0
    )


def _height_numbers(cell: Cell, size_um: float) -> dict[str, float]:
    """Rates of a cell's numbers by its height, shared by its sections."""
    if not cell.layers:
        return {"height_um": 1.0}
    return {
        f"layers.{i}.height_um": share
        for i, share in enumerate(cell.height_shares)
        if share
    }


def _films(cell: Cell, *, under: bool) -> dict[str, float]:
    """Rates of layer heights by the total height of the films under or on the pillar.

    The films lie under all sections of the pillar's own material, or on all of them.
    Each grows in proportion to its height; {} for a cell without layers.
    """
    sections = [i for i, layer in enumerate(cell.layers) if layer.material is None]
    if not sections:
        return {}
    films = range(sections[0]) if under else range(sections[-1] + 1, len(cell.layers))
    total_um = sum(cell.layers[i].height_um for i in films)
    return {f"layers.{i}.height_um": cell.layers[i].height_um / total_um for i in films}


def _cd_error(
    name: str, meaning: str, sigma: float, bound: float, terms: Terms, **more: Any
) -> Perturbation:
    """Row of a diameter error in nm: bias(u, v) = sum c u^i v^j, (u, v) over the
    radius.

    Args:
        name: of the row.
        meaning: for reports.
        sigma: prior standard deviation, nm.
        bound: largest amount of either sign, nm.
        terms: (c, i, j) in nm per unit of the row.
        more: further fields of the row.
    """
    nm = tuple((c * 1e-3, i, j) for c, i, j in terms)
    return Perturbation(
        name, meaning, 1.0, sigma, -bound, bound, CDError(nm), 1e-3, **more
    )


def _zernike(name: str, norm: float, terms: Terms) -> Perturbation:
    """Row of a Zernike wave-front error (Noll 1976), rad rms over the disc.

    Args:
        name: of the polynomial.
        norm: squared factor that makes its rms 1.
        terms: (c, i, j) of the polynomial sum c u^i v^j.
    """
    rad = tuple((math.sqrt(norm) * c, i, j) for c, i, j in terms)
    return Perturbation(
        f"{name}_rad",
        f"Zernike {name} of the wave front, rms",
        0.05,
        1.0,
        -6.0,
        6.0,
        WavefrontError(rad),
    )


def _unstated(
    name: str,
    meaning: str,
    acts: ResponseError,
    scale: float,
    sigma: float,
    bound: float,
) -> Perturbation:
    """Row of an error in nm that no process has unless it is stated.

    Args:
        name: of the row.
        meaning: for reports.
        acts: its derivative.
        scale: typical uncertainty, nm.
        sigma: prior standard deviation, nm.
        bound: largest amount of either sign, nm.
    """
    return Perturbation(
        name,
        meaning,
        scale,
        sigma,
        -bound,
        bound,
        acts,
        1e-3,
        free=False,
        drawn=DrawnPerturbation(name, 0.0),
    )


USUAL_UM = 0.85  # wavelength of the lenses that the sizes in nm below are of
PERTURBATIONS: tuple[Perturbation, ...] = (
    _cd_error(
        "bias_nm",
        "diameter minus design, mean over the lens",
        15.0,
        26.0,
        ((1, 0, 0),),
        drawn=DrawnPerturbation("bias_nm", 4.0),
        reversible=True,
        measured_by="CDs at the centre (SEM)",
    ),
    _cd_error(
        "bias_x_nm",
        "diameter bias at the +x rim less that at the axis",
        10.0,
        15.0,
        ((1, 1, 0),),
        drawn=DrawnPerturbation("gradient_nm", 3.0, 0.5),
        reversible=True,
        measured_by="CDs at both rims (SEM)",
    ),
    _cd_error(
        "bias_y_nm",
        "diameter bias at the +y rim less that at the axis",
        10.0,
        15.0,
        ((1, 0, 1),),
        drawn=DrawnPerturbation("gradient_nm", 3.0, 0.5),
        reversible=True,
        measured_by="CDs at both rims (SEM)",
    ),
    _cd_error(
        "bias_r_nm",
        "diameter bias at the rim less that at the axis, times 1/2 (2 rho² - 1)",
        10.0,
        15.0,
        ((1, 2, 0), (1, 0, 2), (-0.5, 0, 0)),
        drawn=DrawnPerturbation("bow_nm", 2.0),
        reversible=True,
        measured_by="CDs along a radius (SEM)",
    ),
    _cd_error(
        "bias_a_nm",
        "saddle of the diameter bias, x² - y² over R²",
        10.0,
        15.0,
        ((1, 2, 0), (-1, 0, 2)),
        free=False,
        effect="a saddle of the diameters",
        probe=3.0,
        measured_by="CDs at four rims (SEM)",
    ),
    _cd_error(
        "bias_o_nm",
        "oblique saddle of the diameter bias, 2xy over R²",
        10.0,
        15.0,
        ((2, 1, 1),),
        free=False,
        effect="an oblique saddle of the diameters",
        probe=3.0,
        measured_by="CDs at four rims (SEM)",
    ),
    Perturbation(
        "height_nm",
        "pillar height minus design",
        5.0,
        10.0,
        -28.0,
        28.0,
        ResponseError(_height_rate, _height_numbers, "height_um"),
        1e-3,
        drawn=DrawnPerturbation("height_nm", 7.0),
        measured_by="the height (AFM) or the power",
    ),
    Perturbation(
        "index",
        "refractive index of the pillars minus design",
        0.02,
        0.02,
        -0.075,
        0.075,
        ResponseError(_index_rate, _cell_number("pillar.n"), "n"),
        free=False,
        drawn=DrawnPerturbation("index", 0.02),
        effect="another refractive index",
        probe=0.01,
        measured_by="the index (ellipsometer)",
    ),
    Perturbation(
        "sidewall_deg",
        "sidewall angle minus design",
        0.3,
        0.5,
        -1.6,
        1.6,
        ResponseError(_sidewall_rate, _cell_number("sidewall_rad")),
        deg,
        free=False,
        drawn=DrawnPerturbation("sidewall_deg", 0.5),
        plausible=2.0,
        effect="a tilted side wall",
        probe=0.5,
        measured_by="a cross-section (SEM)",
    ),
    _unstated(
        "width_nm",
        "side of a rectangle or ellipse along its x, minus design and bias",
        ResponseError(_side_rate, _width_numbers),
        1.0,
        2.0,
        12.0,
    ),
    _unstated(
        "length_nm",
        "side of a rectangle or ellipse along its y, minus design and bias",
        ResponseError(_side_rate, _length_numbers),
        1.0,
        2.0,
        12.0,
    ),
    Perturbation(
        "turn_deg",
        "turn of every pillar in the plane, from +x to +y, minus design",
        0.2,
        0.3,
        -3.0,
        3.0,
        ResponseError(_zero_rate, _turn_numbers),
        deg,
        free=False,
        drawn=DrawnPerturbation("turn_deg", 0.0),
    ),
    _unstated(
        "pedestal_nm",
        "height of the films under a layered pillar's own material, minus design",
        ResponseError(_zero_rate, lambda cell, size_um: _films(cell, under=True)),
        2.0,
        5.0,
        30.0,
    ),
    _unstated(
        "cap_nm",
        "height of the films on it (a residual mask), minus design",
        ResponseError(_zero_rate, lambda cell, size_um: _films(cell, under=False)),
        2.0,
        5.0,
        30.0,
    ),
    _zernike("astigmatism", 6, ((1, 2, 0), (-1, 0, 2))),
    _zernike("oblique_astigmatism", 6, ((2, 1, 1),)),
    _zernike("coma_x", 8, ((3, 3, 0), (3, 1, 2), (-2, 1, 0))),
    _zernike("coma_y", 8, ((3, 0, 3), (3, 2, 1), (-2, 0, 1))),
    _zernike("trefoil_x", 8, ((1, 3, 0), (-3, 1, 2))),
    _zernike("trefoil_y", 8, ((3, 2, 1), (-1, 0, 3))),
    _zernike(
        "spherical",
        5,
        ((6, 4, 0), (12, 2, 2), (6, 0, 4), (-6, 2, 0), (-6, 0, 2), (1, 0, 0)),
    ),
)


def wavelength_scale(wavelength_um: float) -> float:
    """Factor of the nm amounts of the table at a wavelength: max(1, wavelength / 0.85
    um).

    Pillars, their height and the tolerances of their tools grow with the wavelength, so
    that errors of one kind turn the phase equally. Lenses of shorter wavelengths come
    from the same writers and etchers, with their nanometres.

    Args:
        wavelength_um: vacuum wavelength, um.
    """
    return max(1.0, wavelength_um / USUAL_UM)


def prior_scale(name: str, wavelength_um: float) -> float:
    """Factor of the prior and bounds of a row at a wavelength; 1 for rows not in nm.

    See :func:`wavelength_scale`.

    Args:
        name: of a row of the table.
        wavelength_um: vacuum wavelength, um.
    """
    return wavelength_scale(wavelength_um) if name.endswith("_nm") else 1.0


def response_errors() -> list[tuple[Perturbation, ResponseError]]:
    """Rows of the table that change the response of a pillar, and how, in order."""
    return [
        (row, row.acts) for row in PERTURBATIONS if isinstance(row.acts, ResponseError)
    ]


def of_kind(kind: Kind) -> Iterator[tuple[int, Perturbation]]:
    """(place in the table, row) of the causes that act in one way, in order.

    Args:
        kind: CDError, ResponseError or WavefrontError.
    """
    return (
        (n, row) for n, row in enumerate(PERTURBATIONS) if isinstance(row.acts, kind)
    )


def names_of_kind(kind: Kind) -> tuple[str, ...]:
    """Names of the causes that act in one way, in order.

    Args:
        kind: CDError, ResponseError or WavefrontError.
    """
    return tuple(row.name for _, row in of_kind(kind))


def with_missing(rows: Array) -> Array:
    """(pillar-response errors, *shape) of the first ``rows`` of it, zeros appended."""
    missing = len(response_errors()) - len(rows)
    return np.concatenate([rows, np.zeros((missing, *rows.shape[1:]))])


def inapplicable_names(cell: Cell) -> tuple[str, ...]:
    """Names of the causes that pillars of this kind cannot have: a round one has no
    length and no turn, one without layers no pedestal.

    Args:
        cell: unit cell with its materials, shape and lattice.
    """
    size = cell.pitch_um / 2
    return tuple(
        row.name for row, acts in response_errors() if not acts.numbers(cell, size)
    )


def polynomial_coefficients(kind: type[CDError] | type[WavefrontError]) -> Array:
    """(rows of the kind, i, j) coefficients of u^i v^j: um or rad a unit of each
    cause.
    """
    rows = [row.acts.terms for row in PERTURBATIONS if isinstance(row.acts, kind)]
    size = 1 + max(max(i, j) for terms in rows for _, i, j in terms)
    coefficients = np.zeros((len(rows), size, size))
    for n, terms in enumerate(rows):
        for c, i, j in terms:
            coefficients[n, i, j] += c
    return coefficients


def derivative_maps(
    kind: type[CDError] | type[WavefrontError], u: Array, v: Array
) -> Array:
    """(rows of the kind, *shape) derivative maps, um or rad for one unit of each row.

    Args:
        kind: CDError or WavefrontError.
        u: (*shape) x over the radius of the lens.
        v: (*shape) y over the radius of the lens.
    """
    return np.stack(
        [
            np.polynomial.polynomial.polyval2d(u, v, coefficients)
            for coefficients in polynomial_coefficients(kind)
        ]
    )


def changed_pillar(
    cell: Cell,
    size_um: float,
    numbers: dict[str, float],
    amount: float,
    wavelength_um: float,
) -> tuple[Cell, float]:
    """Cell and size of a pillar whose numbers changed by rate × amount.

    Args:
        cell: the designed pillar.
        size_um: its size.
        numbers: rate of each number, named as in a cell file (``height_um``,
            ``shape.ratio``, ``layers.0.height_um``, ``pillar.n``); ``size_um``, and
            ``grow_um`` of all edge pairs.
        amount: factor of the rates.
        wavelength_um: in vacuum, of the refractive index.
    """
    layers = list(cell.layers)
    for name, rate in numbers.items():
        path = name.split(".")
        change = rate * amount
        if name == "size_um":
            size_um += change
        elif name == "grow_um":
            layers = [_grown(section, name, change) for section in cell.sections]
        elif name == "pillar.n":
            n = index(cell.pillar, wavelength_um)
            cell = dataclasses.replace(cell, pillar=Index(n.real + change, n.imag))
        elif path[0] == "shape":
            cell = dataclasses.replace(cell, shape=_grown(cell.shape, path[1], change))
        elif path[0] == "layers":
            layer = int(path[1])
            layers[layer] = _grown(layers[layer], path[2], change)
        else:
            cell = _grown(cell, name, change)
    if layers:
        height_um = sum(layer.height_um for layer in layers)
        cell = dataclasses.replace(cell, layers=tuple(layers), height_um=height_um)
    return cell, size_um


def _grown(record: Any, name: str, change: float) -> Any:
    """A copy of a record with one of its numbers larger by ``change``."""
    return dataclasses.replace(record, **{name: getattr(record, name) + change})
