"""From a cell, a size and a plane wave to the numbers of one modal case; raises for
shapes that the elements cannot follow.
"""

import math
from dataclasses import dataclass

from metalens.cell import Cell, Film, Incidence, index
from metalens.core.errors import CellError

# of Bloch phase: below, t differs from normal incidence by less than 1e-12
NORMAL_RAD = 1e-6
Films = tuple[tuple[complex, float], ...]  # permittivity, thickness


@dataclass(frozen=True, slots=True)
class ModalCase:
    """One problem in half pitches: what the linear algebra needs.

    rho: diameter over pitch. k0, height: vacuum wavenumber and height.
    below, above: permittivities of the half-spaces. disc, around: of the layer.
    bloch: kx. p: whether oblique light has its electric field in the plane of
        incidence.
    under, over: films, nearest to the layer first.
    """

    rho: float
    k0: float
    height: float
    below: float
    above: float
    disc: complex
    around: complex
    bloch: float
    p: bool
    under: Films = ()
    over: Films = ()


def case_of(cell: Cell, diameter_um: float, light: Incidence) -> ModalCase:
    """The modal problem of one pillar and plane wave, in half pitches.

    Args:
        cell: upright round pillar on a square lattice, films allowed.
        diameter_um: of the pillar. light: with its plane of incidence along an axis.

    Raises:
        CellError: a tilted sidewall, a plane of incidence off the lattice axes, an
            absorbing half-space, or a diameter out of range.
    """
    diameter_um = float(diameter_um)
    check_shape(cell, diameter_um)
    along = plane_of_incidence(light)
    below, above = half_spaces(cell, light)
    disc, around = (
        index(material, light.wavelength_um) for material in (cell.pillar, cell.fill)
    )
    k0 = 2 * math.pi / light.wavelength_um
    half_pitch_um = cell.pitch_um / 2
    sine = abs(math.sin(light.angle_rad))
    bloch = k0 * sine * half_pitch_um
    if bloch <= NORMAL_RAD:
        bloch = 0.0

    def films(stack: tuple[Film, ...]) -> Films:
        return tuple(
            (
                index(film.material, light.wavelength_um) ** 2,
                film.thickness_um / half_pitch_um,
            )
            for film in stack
        )

    return ModalCase(
        rho=diameter_um / cell.pitch_um,
        k0=k0 * half_pitch_um,
        height=cell.height_um / half_pitch_um,
        below=below.real**2,
        above=above.real**2,
        disc=disc**2,
        around=around**2,
        bloch=bloch,
        p=bloch > 0 and light.polarization in ("p", along),
        under=films(cell.under),
        over=films(cell.over[::-1]),
    )


def plane_of_incidence(light: Incidence) -> str:
    """The lattice axis, "x" or "y", that the plane of incidence of a ``light``
    contains.

    Raises:
        CellError: a plane off the lattice axes.
    """
    quarter = light.azimuth_rad / (math.pi / 2)
    if light.angle_rad and abs(quarter - round(quarter)) > 1e-12:
        raise CellError(
            f"azimuth_rad = {light.azimuth_rad}: the modal engine takes planes of incidence along the lattice axes "
            "(multiples of pi/2); use metalens.rcwa for others"
        )
    return "x" if round(quarter) % 2 == 0 else "y"


def half_spaces(cell: Cell, light: Incidence) -> tuple[complex, complex]:
    """Refractive indices of substrate and cover of a ``cell``, neither absorbing, with
    a zero order of the ``light`` in both.

    Raises:
        CellError: says which absorbs, or that the angle is too large.
    """
    below, above = (index(m, light.wavelength_um) for m in (cell.substrate, cell.cover))
    for name, n in (("substrate", below), ("cover", above)):
        if n.imag:
            raise CellError(
                f"{name} absorbs (index {n}): the modal engine needs real half-spaces; use metalens.rcwa, "
                "or take the absorbing part as a film"
            )
    if abs(math.sin(light.angle_rad)) >= min(below.real, above.real):
        raise CellError(
            f"angle_rad = {light.angle_rad}: no zero order in a half-space of index {min(below.real, above.real)}"
        )
    return below, above


def check_shape(cell: Cell, diameter_um: float) -> None:
    """Raise for a ``cell`` or a ``diameter_um`` that the elements cannot follow.

    Raises:
        CellError: no upright round pillar, or one that touches its neighbours.
    """
    if not cell.round:
        raise CellError(
            f"the modal engine takes round pillars on a square lattice, not {cell.described}; use metalens.rcwa"
        )
    if cell.sidewall_rad:
        raise CellError(
            "the elements take an upright pillar; metalens.rcwa solves tilted walls"
        )
    if not (math.isfinite(diameter_um) and 0 < diameter_um < cell.pitch_um):
        raise CellError(
            f"diameter_um = {diameter_um} on a pitch of {cell.pitch_um} um: the elements that follow the disc need "
            "one above 0 and below the pitch; touching pillars are solved by metalens.rcwa"
        )
