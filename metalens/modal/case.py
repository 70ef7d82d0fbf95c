"""From a cell, a size and a plane wave to the numbers of one modal case, and those of
its solution; refuses what the
elements cannot follow."""

import math
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Film, Incidence, index
from metalens.core.errors import CellError

LEAST_CONTRAST = (
    2.0  # of permittivities, of a pillar that is told from its surroundings
)
LOW, TALL = 0.5, 16.0  # heights in half pitches
DENSE, ORDERS = 2.0, 1.05  # waves in a pitch, in the layer and in the half-spaces
STEEP_RAD = 1.0  # half Bloch phase
GUIDING = 1.2  # permittivity between pillars over that of the denser half-space
RARER = 3.0
NORMAL_RAD = (
    1e-6  # of Bloch phase: below, t differs from normal incidence by less than 1e-12
)


Films = tuple[tuple[complex, float], ...]  # permittivity, thickness


@dataclass(frozen=True, slots=True)
class ModalCase:
    """One problem in half pitches: what the linear algebra needs.

    rho: diameter over pitch. k0, height: vacuum wavenumber and height. below, above:
    permittivities of the
    half-spaces. disc, around: of the layer. bloch: kx. p: plane of incidence holds the
    electric field.
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

    @property
    def size(self) -> float:
        """Waves in a pitch, in the denser medium of the layer."""
        return self.k0 * math.sqrt(max(abs(self.disc), abs(self.around))) / math.pi

    @property
    def regime_factor(self) -> float:
        """0 in the regime that the error factors are calibrated for, else 1; ``RARER``
        for a disc of the rarer medium.

        The regime: a pillar of the denser medium, a quarter to eight pitches high, at
        most two waves in a pitch, no order but zero at normal incidence, moderate
        angles, between media hardly denser than either half-space. Outside it the forms
        on a coarse mesh err more alike. If the layer between the pillars guides light,
        resonances are narrow and the bound may be too small by 2 times.
        """
        disc, around = abs(self.disc), abs(self.around)
        outside = self.k0 * math.sqrt(max(self.below, self.above)) / math.pi
        if disc < around:
            return RARER
        usual = (
            (disc >= LEAST_CONTRAST * around or self.disc.imag > disc / 2)
            and LOW <= self.height <= TALL
            and self.size <= DENSE
            and outside <= ORDERS
            and self.bloch <= STEEP_RAD
            and around <= GUIDING * max(self.below, self.above)
        )
        return 0.0 if usual else 1.0


@dataclass(frozen=True, eq=False, slots=True)
class MeshSolution:
    """Solution on one mesh.

    matrix: (2, 2) zero-order scattering matrix, mean of both forms.
    waves, rim: half the difference of the forms, by the wavenumbers of the layer modes
        and beyond.
    drift: change of the matrix per relative error of the transverse wavenumbers squared
        of the layer modes, which both forms share.
    energy: mean of both forms. unknowns: of both forms.
    grazing: change of the matrix for what the mesh misplaces cutoffs.
    cutoff: how near an order is to its cutoff, see
        :func:`metalens.modal.match.cutoff_proximity`.
    bloch: half the Bloch phase. size: wavelengths in a pitch, in the densest medium.
    regime_factor: as in :class:`ModalCase`; where it is not 0, damping of round trips
        in the layer.
    """

    matrix: np.ndarray
    waves: float
    rim: float
    drift: float
    energy: float
    unknowns: int
    grazing: float = 0.0
    cutoff: float = 0.0
    bloch: float = 0.0
    size: float = 0.0
    regime_factor: float = 0.0
    damping: float = 1.0

    @property
    def spread(self) -> float:
        """Half of how far the forms are apart, waves and rim together."""
        return self.waves + self.rim


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
    disc, around = (index(m, light.wavelength_um) for m in (cell.pillar, cell.fill))
    k0, half, sine = (
        2 * math.pi / light.wavelength_um,
        cell.pitch_um / 2,
        abs(math.sin(light.angle_rad)),
    )
    bloch = k0 * sine * half

    def films(stack: tuple[Film, ...]) -> Films:
        return tuple(
            (index(film.material, light.wavelength_um) ** 2, film.thickness_um / half)
            for film in stack
        )

    return ModalCase(
        rho=diameter_um / cell.pitch_um,
        k0=k0 * half,
        height=cell.height_um / half,
        below=below.real**2,
        above=above.real**2,
        disc=disc**2,
        around=around**2,
        bloch=bloch if bloch > NORMAL_RAD else 0.0,
        p=light.polarization in ("p", along),
        under=films(cell.under),
        over=films(cell.over[::-1]),
    )


def plane_of_incidence(light: Incidence) -> str:
    """The lattice axis, "x" or "y", that the plane of incidence of a ``light`` contains.

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
    """Refractive indices of substrate and cover of a ``cell``, neither absorbing, with a
    zero order of the ``light`` in both.

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
    """Refuse a ``cell`` or a ``diameter_um`` that the elements cannot follow.

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
