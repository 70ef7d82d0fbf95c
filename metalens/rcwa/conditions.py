"""From a cell, a wavelength and a direction to the numbers of one RCWA case; refuses
what cannot be computed.
"""

import math
from dataclasses import dataclass
from typing import Literal

from metalens.cell import Cell, Film, Incidence, materials
from metalens.core.errors import CellError
from metalens.rcwa.orders import basis as fourier
from metalens.rcwa.orders.waves import PlaneWaves, plane_waves
from metalens.rcwa.stack import StackMedia

_STRAIGHT = 1e-15  # cos or sin of an azimuth that lies in a mirror plane, to rounding


@dataclass(frozen=True, slots=True)
class DiscCase:
    """One wavelength, direction and polarisation of a cell, whatever the diameter.

    k0: 2 pi / wavelength_um.
    kx, ky: tangential wave vector over k0; turned into the plane y = 0 where a mirror
    plane allows it.
    symmetry: of the fields, see :mod:`metalens.rcwa.orders.basis`; wave: which zero
    order is incident.
    pillar, between: indices, exp(-iwt). media: indices and reduced thicknesses around
    and between.
    """

    cell: Cell
    wavelength_um: float
    k0: float
    kx: float
    ky: float
    azimuth_rad: float
    symmetry: fourier.Symmetry
    wave: Literal["s", "p"]
    pillar: complex
    between: complex
    media: StackMedia


def disc_case(cell: Cell, light: Incidence) -> DiscCase:
    """The case of a cell and a plane wave.

    Raises:
        CellError: a polarisation that is ambiguous in this direction, or a zero order
            that does not propagate in
            the substrate.
        MaterialError: a wavelength outside the range of a material.
    """
    if not cell.round:
        raise CellError(
            f"this solver takes round pillars on a square lattice, not {cell.described}"
        )
    k0 = 2 * math.pi / light.wavelength_um

    def index(material: object) -> complex:
        return materials.index(material, light.wavelength_um)  # type: ignore[arg-type]

    def films(stack: tuple[Film, ...]) -> tuple[tuple[complex, float], ...]:
        return tuple((index(film.material), film.thickness_um * k0) for film in stack)

    media = StackMedia(
        index(cell.substrate),
        index(cell.cover),
        films(cell.under),
        films(cell.over),
        (cell.height_um * k0,),
    )
    kx, ky, azimuth_rad, symmetry, wave = incidence_of(light)
    if media.substrate.real <= math.hypot(kx, ky):
        raise CellError(
            f"sin(angle_rad) = {math.hypot(kx, ky):.6g} in a substrate of n = {media.substrate.real:.6g}: the light "
            "cannot come from there; need a smaller angle_rad or another substrate"
        )
    pillar, between = index(cell.pillar), index(cell.fill)
    return DiscCase(
        cell,
        light.wavelength_um,
        k0,
        kx,
        ky,
        azimuth_rad,
        symmetry,
        wave,
        pillar,
        between,
        media,
    )


def case_waves(this: DiscCase, harmonics: int) -> tuple[PlaneWaves, int]:
    """The waves of a case within ``harmonics`` orders, and the place of its incident
    wave.
    """
    ways = plane_waves(
        fourier.disc_basis(harmonics, this.symmetry),
        pitch_um=this.cell.pitch_um,
        wavelength_um=this.wavelength_um,
        kx=this.kx,
        ky=this.ky,
        azimuth_rad=this.azimuth_rad,
    )
    return ways, ways.zero_p if this.wave == "p" else ways.zero_s


def check_diameter(cell: Cell, diameter_um: float) -> None:
    """Refuse a diameter that is no length, or pillars that overlap (touching ones can
    be computed).

    Raises:
        CellError: says which diameter, of foot or top where the wall is tilted.
    """
    if not (math.isfinite(diameter_um) and diameter_um >= 0):
        raise CellError(f"diameter_um = {diameter_um}: need a finite length >= 0")
    if diameter_um == 0:
        return
    slant = cell.height_um * math.tan(cell.sidewall_rad)
    for name, wide in (("foot", diameter_um + slant), ("top", diameter_um - slant)):
        if wide > cell.pitch_um:
            raise CellError(
                f"diameter_um = {diameter_um}: pillars overlap, {wide:.6g} um wide at the {name} on a pitch of "
                f"{cell.pitch_um:.6g} um; need at most the pitch"
            )
        if wide < 0:
            raise CellError(
                f"diameter_um = {diameter_um}: the wall of {cell.sidewall_rad:.4g} rad over {cell.height_um:.6g} um "
                f"closes the pillar below its {name}; need at least {abs(slant):.6g} um"
            )


def incidence_of(
    light: Incidence,
) -> tuple[float, float, float, fourier.Symmetry, Literal["s", "p"]]:
    """(kx, ky, azimuth, symmetry of the fields, which zero order comes); turned into
    the plane y = 0 where it may be.

    Raises:
        CellError: a polarisation along x or y, in a plane of incidence off both.
    """
    angle_rad, azimuth_rad, polarization = (
        light.angle_rad,
        light.azimuth_rad,
        light.polarization,
    )
    if angle_rad == 0:
        return (
            0.0,
            0.0,
            0.0,
            "x",
            "p",
        )  # the disc and the lattice look alike from x and y: one solution serves all
    sine, c, s = math.sin(angle_rad), math.cos(azimuth_rad), math.sin(azimuth_rad)
    along_x, along_y = abs(s) < _STRAIGHT, abs(c) < _STRAIGHT
    wave: Literal["s", "p"] = "p" if polarization == "p" else "s"
    if polarization in ("x", "y"):
        if not (along_x or along_y):
            raise CellError(
                f"polarization = {polarization!r} at angle_rad = {angle_rad}, azimuth_rad = {azimuth_rad}: ambiguous "
                "off the axes; need 's' or 'p'"
            )
        wave = "p" if along_x == (polarization == "x") else "s"
    if along_x or along_y:
        return sine, 0.0, 0.0, wave, wave
    return sine * c, sine * s, azimuth_rad, "none", wave


def taper_um(cell: Cell) -> float:
    """Change of the diameter in micrometres for each unit of lift."""
    return -2 * math.tan(cell.sidewall_rad) * cell.height_um
