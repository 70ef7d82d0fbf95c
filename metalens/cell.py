"""The unit cell: one round pillar on a square lattice between a substrate and a cover."""

import math
from dataclasses import dataclass

from metalens.errors import CellError


@dataclass(frozen=True, slots=True)
class Index:
    """A refractive index given as plain numbers, the same at every wavelength (exp(-iwt): k >= 0 absorbs)."""

    n: float
    k: float = 0.0

    def __post_init__(self) -> None:
        if not (self.n > 0 and math.isfinite(self.n) and self.k >= 0 and math.isfinite(self.k)):
            raise CellError(f"refractive index {self.n}+{self.k}i: need finite n > 0 and k >= 0")


Material = str | Index  # a name known to metalens.materials, the path of a CSV file, or plain numbers


@dataclass(frozen=True, slots=True)
class Film:
    """A homogeneous layer of a coating or substrate stack."""

    material: Material
    thickness_um: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.thickness_um) and self.thickness_um >= 0):
            raise CellError(f"film thickness {self.thickness_um} um: need a finite value >= 0")


@dataclass(frozen=True, slots=True)
class Cell:
    """One pillar of circular section; light comes from the substrate and leaves into the cover.

    pitch_um: lattice constant (x and y).
    height_um: of the pillar.
    pillar, substrate, cover, between: materials (``between`` fills the space around the pillar).
    sidewall_rad: tilt of the wall from the vertical, above 0 where the foot is wider than the top; the
        diameter of a pillar is the one at half its height.
    under, over: films between substrate and pillar, and between pillar and cover, in the order that the
        light meets them.
    """

    pitch_um: float
    height_um: float = 0.7
    pillar: Material = "a-Si"
    substrate: Material = "SiO2"
    cover: Material = "air"
    between: Material = "air"
    sidewall_rad: float = 0.0
    under: tuple[Film, ...] = ()
    over: tuple[Film, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.pitch_um) and self.pitch_um > 0):
            raise CellError(f"pitch_um = {self.pitch_um}: need a finite length above 0")
        if not (math.isfinite(self.height_um) and self.height_um >= 0):
            raise CellError(f"height_um = {self.height_um}: need a finite length >= 0")
        if not abs(self.sidewall_rad) < math.pi / 4:
            raise CellError(f"sidewall_rad = {self.sidewall_rad}: need an angle within +-pi/4")
