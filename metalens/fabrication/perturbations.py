"""Fabrication perturbations of a lens: one table with unit, prior, bounds, derivative,
symmetry and measurement of each.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from metalens.cell import Cell, Index, index
from metalens.cell.shapes import Ellipse, Rectangle
from metalens.core.arrays import Array

Terms = tuple[tuple[float, int, int], ...]  # (c, i, j): c u^i v^j


@dataclass(frozen=True, slots=True)
class Guide:
    """Pillars as guides of one mode, over their diameters; what the quick derivatives
    are made of.

    k: wavenumber in vacuum, rad/um. diameter_um, effective, slope, curvature: (n,)
        effective index and its derivatives by the diameter. index, around: of pillar
        and surroundings. height_um, sidewall_rad: of the design.
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
        (:class:`metalens.fabrication.Solved`), empty where none does.
    """

    quick: Callable[[Guide], Array]
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
class Drawn:
    """How a process spreads a cause, in PROCESS.toml's table ``spread``.

    name, sigma: entry there and its default. share: of the entry's amount that the
        cause gets; two causes of one entry are the x and y of a direction that every
        lens draws anew.
    """

    name: str
    sigma: float
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Perturbation:
    """One row: a number that says how a made lens differs from its design; 0 is the
    design.

    meaning: for reports. scale: a typical uncertainty, for steps and plots. sigma:
        prior knowledge without metrology.
    low, high: bounds. acts: its derivative. unit: um, rad or 1 in one unit of the name.
    free: fitted unless stated otherwise. drawn: how the process spreads it, where it
        does. plausible: standard deviation that is assumed where it is neither
        fitted nor stated; sigma where 0. effect: as a cause in words, where it is
        looked for while it is not fitted; probe: so much of it is tried then.
    extra: fitted too where the usual ones do not explain the frames. reversible: near
        focus the images of a lens with the opposite sign look equal. measured_by: what
        measures it besides the frames.
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
    drawn: Drawn | None = None
    plausible: float = 0.0
    effect: str = ""
    probe: float = 0.0
    extra: bool = False
    reversible: bool = False
    measured_by: str = ""


def _by_height(g: Guide) -> Array:
    return 1j * g.k * g.effective


def _by_index(g: Guide) -> Array:
    """With b = (n_eff² - 1) / (n² - 1) a function of D sqrt(n² - 1): d n_eff / dn = (b
    n + n D b' / 2) / n_eff.
    """
    contrast = g.index**2 - g.around**2
    b = (g.effective**2 - g.around**2) / contrast
    by_diameter = 2 * g.effective * g.slope / contrast
    return (
        1j
        * g.k
        * g.height_um
        * (b * g.index + g.index * g.diameter_um * by_diameter / 2)
        / g.effective
    )


def _by_sidewall(g: Guide) -> Array:
    """Pillars are measured at half height: the wall acts in second order, k n_eff'' s
    h³ / 3.
    """
    return 1j * g.k * g.curvature * g.sidewall_rad * g.height_um**3 / 3


def _by_side(g: Guide) -> Array:
    """A round pillar that is wider along one axis: the mean over both polarisations is
    half of the diameter's.
    """
    return 0.5j * g.k * g.height_um * g.slope


def _by_none(g: Guide) -> Array:
    """A plain round pillar is the same at any turn, and has no other films under or on
    it.
    """
    return np.zeros_like(g.effective, complex)


def _number(name: str) -> Callable[[Cell, float], dict[str, float]]:
    """A number that every cell has."""
    return lambda cell, size_um: {name: 1.0}


def _width(cell: Cell, size_um: float) -> dict[str, float]:
    """Along the shape's own x at the length that it has, where it has two sides: L =
    ratio times the size.
    """
    ratio = _ratio(cell)
    return {"size_um": 1.0, "shape.ratio": -ratio / size_um} if ratio else {}


def _length(cell: Cell, size_um: float) -> dict[str, float]:
    """Along the shape's own y at the width that it has."""
    return {"shape.ratio": 1 / size_um} if _ratio(cell) else {}


def _turn(cell: Cell, size_um: float) -> dict[str, float]:
    return {"shape.angle_rad": 1.0} if hasattr(cell.shape, "angle_rad") else {}


def _ratio(cell: Cell) -> float:
    """Of the second side of a rectangle or an ellipse to its size; 0 for other shapes."""
    return (
        float(cell.shape.ratio) if isinstance(cell.shape, Rectangle | Ellipse) else 0.0
    )


def _heights(cell: Cell, size_um: float) -> dict[str, float]:
    """Of the pillar, or of its sections."""
    if not cell.layers:
        return {"height_um": 1.0}
    return {
        f"layers.{i}.height_um": share
        for i, share in enumerate(cell.height_shares)
        if share
    }


def _films(cell: Cell, *, under: bool) -> dict[str, float]:
    """Of the films under all sections of the pillar's own material, or on them, in
    proportion to their heights.
    """
    own = [i for i, layer in enumerate(cell.layers) if layer.material is None]
    if not own:
        return {}
    places = range(own[0]) if under else range(own[-1] + 1, len(cell.layers))
    whole = sum(cell.layers[i].height_um for i in places)
    return {f"layers.{i}.height_um": cell.layers[i].height_um / whole for i in places}


def _cd_error(
    name: str, meaning: str, sigma: float, bound: float, terms: Terms, **more: Any
) -> Perturbation:
    nm = tuple((c * 1e-3, i, j) for c, i, j in terms)
    return Perturbation(
        name, meaning, 1.0, sigma, -bound, bound, CDError(nm), 1e-3, **more
    )


def _zernike(name: str, norm: float, terms: Terms) -> Perturbation:
    """A Zernike polynomial (Noll 1976) of unit root mean square on the disc."""
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


def _side(
    name: str, meaning: str, numbers: Callable[[Cell, float], dict[str, float]]
) -> Perturbation:
    acts = ResponseError(_by_side, numbers)
    return Perturbation(
        name,
        meaning,
        1.0,
        2.0,
        -12.0,
        12.0,
        acts,
        1e-3,
        free=False,
        drawn=Drawn(name, 0.0),
    )


def _film(name: str, meaning: str, *, under: bool) -> Perturbation:
    acts = ResponseError(_by_none, lambda cell, size_um: _films(cell, under=under))
    return Perturbation(
        name,
        meaning,
        2.0,
        5.0,
        -30.0,
        30.0,
        acts,
        1e-3,
        free=False,
        drawn=Drawn(name, 0.0),
    )


DEG = math.pi / 180
USUAL_UM = 0.85  # wavelength of the lenses that the sizes in nm below are of
PERTURBATIONS: tuple[Perturbation, ...] = (
    _cd_error(
        "bias_nm",
        "diameter minus design, mean over the lens",
        15.0,
        26.0,
        ((1, 0, 0),),
        drawn=Drawn("bias_nm", 4.0),
        reversible=True,
        measured_by="CDs at the centre (SEM)",
    ),
    _cd_error(
        "bias_x_nm",
        "diameter bias at the +x rim less that at the axis",
        10.0,
        15.0,
        ((1, 1, 0),),
        drawn=Drawn("gradient_nm", 3.0, 0.5),
        reversible=True,
        measured_by="CDs at both rims (SEM)",
    ),
    _cd_error(
        "bias_y_nm",
        "diameter bias at the +y rim less that at the axis",
        10.0,
        15.0,
        ((1, 0, 1),),
        drawn=Drawn("gradient_nm", 3.0, 0.5),
        reversible=True,
        measured_by="CDs at both rims (SEM)",
    ),
    _cd_error(
        "bias_r_nm",
        "diameter bias at the rim less that at the axis, times 1/2 (2 rho² - 1)",
        10.0,
        15.0,
        ((1, 2, 0), (1, 0, 2), (-0.5, 0, 0)),
        drawn=Drawn("bow_nm", 2.0),
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
        extra=True,
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
        extra=True,
        measured_by="CDs at four rims (SEM)",
    ),
    Perturbation(
        "height_nm",
        "pillar height minus design",
        5.0,
        10.0,
        -28.0,
        28.0,
        ResponseError(_by_height, _heights, "height_um"),
        1e-3,
        drawn=Drawn("height_nm", 7.0),
        measured_by="the height (AFM) or the power",
    ),
    Perturbation(
        "index",
        "refractive index of the pillars minus design",
        0.02,
        0.02,
        -0.075,
        0.075,
        ResponseError(_by_index, _number("pillar.n"), "n"),
        free=False,
        drawn=Drawn("index", 0.02),
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
        ResponseError(_by_sidewall, _number("sidewall_rad")),
        DEG,
        free=False,
        drawn=Drawn("sidewall_deg", 0.5),
        plausible=2.0,
        effect="a tilted side wall",
        probe=0.5,
        measured_by="a cross-section (SEM)",
    ),
    _side(
        "width_nm",
        "side of a rectangle or ellipse along its x, minus design and bias",
        _width,
    ),
    _side(
        "length_nm",
        "side of a rectangle or ellipse along its y, minus design and bias",
        _length,
    ),
    Perturbation(
        "turn_deg",
        "turn of every pillar in the plane, from +x to +y, minus design",
        0.2,
        0.3,
        -3.0,
        3.0,
        ResponseError(_by_none, _turn),
        DEG,
        free=False,
        drawn=Drawn("turn_deg", 0.0),
    ),
    _film(
        "pedestal_nm",
        "height of the films under a layered pillar's own material, minus design",
        under=True,
    ),
    _film(
        "cap_nm",
        "height of the films on it (a residual mask), minus design",
        under=False,
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
    """How much larger what the table gives in nm is for a lens of this wavelength:
    wavelength / 0.85 um, 1 at least.

    Pillars, their height and what their tools are asked to hold grow with the
    wavelength, so that errors of one kind turn the phase equally; lenses of shorter waves
    come from the same writers and etchers, with their nanometres.

    Args:
        wavelength_um: vacuum wavelength, um.
    """
    return max(1.0, wavelength_um / USUAL_UM)


def prior_scale(name: str, wavelength_um: float) -> float:
    """By which prior and bounds of a row are multiplied for a wavelength:
    :func:`wavelength_scale` of what is given in nm.

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


def with_missing(rows: Sequence[Array]) -> Array:
    """(pillar-response errors, *shape) of the first rows of the table: those that are
    not there are 0.
    """
    return np.stack(
        [*rows, *[np.zeros_like(rows[0])] * (len(response_errors()) - len(rows))]
    )


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
    """(rows of the kind, i, j) coefficients of u^i v^j: um or rad a unit of each cause."""
    return _polynomials(kind.__name__)


@functools.cache
def _polynomials(kind: str) -> Array:
    found = [
        row.acts.terms
        for row in PERTURBATIONS
        if type(row.acts).__name__ == kind and not isinstance(row.acts, ResponseError)
    ]
    size = 1 + max((max(i, j) for terms in found for _, i, j in terms), default=0)
    out = np.zeros((len(found), size, size))
    for n, terms in enumerate(found):
        for c, i, j in terms:
            out[n, i, j] += c
    return out


def derivative_maps(
    kind: type[CDError] | type[WavefrontError], u: Array, v: Array
) -> Array:
    """(rows of the kind, *shape) derivative maps at lens places (u, v) over the radius."""
    return np.stack(
        [
            np.polynomial.polynomial.polyval2d(u, v, each)
            for each in polynomial_coefficients(kind)
        ]
    )


def changed_pillar(
    cell: Cell,
    size_um: float,
    numbers: dict[str, float],
    amount: float,
    wavelength_um: float,
) -> tuple[Cell, float]:
    """A pillar whose numbers have grown.

    Args:
        cell, size_um: the pillar as designed.
        numbers: rate of each number, named as in a cell file (``height_um``,
            ``shape.ratio``, ``layers.0.height_um``, ``pillar.n``); ``size_um``, and
            ``grow_um`` of all edge pairs.
        amount: that the rates are multiplied by.
        wavelength_um: in vacuum, of the refractive index.

    Returns:
        Cell and size of the changed pillar.
    """
    layers = list(cell.layers)
    for name, rate in numbers.items():
        first, *rest = name.split(".")
        change = rate * amount
        if name == "size_um":
            size_um += change
        elif name == "grow_um":
            layers = [_grown(layer, name, change) for layer in cell.sections]
        elif name == "pillar.n":
            n = index(cell.pillar, wavelength_um)
            cell = dataclasses.replace(cell, pillar=Index(n.real + change, n.imag))
        elif first == "shape":
            cell = dataclasses.replace(cell, shape=_grown(cell.shape, rest[0], change))
        elif first == "layers":
            layers[int(rest[0])] = _grown(layers[int(rest[0])], rest[1], change)
        else:
            cell = _grown(cell, name, change)
    if layers:
        height_um = sum(layer.height_um for layer in layers)
        cell = dataclasses.replace(cell, layers=tuple(layers), height_um=height_um)
    return cell, size_um


def _grown(record: Any, name: str, change: float) -> Any:
    """A record with one number larger."""
    return dataclasses.replace(record, **{name: getattr(record, name) + change})
