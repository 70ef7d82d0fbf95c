"""The unit cell: one pillar of any shape on its lattice, between a substrate and a
cover.
"""

import math
from dataclasses import dataclass, field, replace

from metalens.cell.lattice import Lattice
from metalens.cell.shapes import Outline
from metalens.cell.shapes.registry import Shape
from metalens.cell.shapes.round import Circle
from metalens.core.errors import CellError

# of the pitch: neighbours that are closer, and what is thinner, no truncation resolves
NARROWEST_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class Index:
    """A refractive index given as plain numbers, the same at every wavelength
    (exp(-iwt): k >= 0 absorbs).

    n: real part, above 0. k: imaginary part, 0 or above.
    """

    n: float
    k: float = 0.0

    def __post_init__(self) -> None:
        if not (
            self.n > 0
            and math.isfinite(self.n)
            and self.k >= 0
            and math.isfinite(self.k)
        ):
            raise CellError(
                f"refractive index {self.n}+{self.k}i: need finite n > 0 and k >= 0"
            )


@dataclass(frozen=True, slots=True)
class Blend:
    """A deposited film: a material with offsets, or mixed with another (Bruggeman's
    effective medium).

    base, other: names or files of materials; share: volume of ``other``. n_offset,
    k_offset: added to the result.
    """

    base: str
    other: str = ""
    share: float = 0.0
    n_offset: float = 0.0
    k_offset: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1 or (self.share > 0 and not self.other):
            raise CellError(
                f"blend share = {self.share} of {self.other!r}: need 0 to 1, and the name of the other"
            )
        if not (math.isfinite(self.n_offset) and math.isfinite(self.k_offset)):
            raise CellError(
                f"blend offsets {self.n_offset}, {self.k_offset}: need finite numbers"
            )


Material = (
    str | Index | Blend
)  # a name known to metalens.materials, the path of a CSV or YAML file, numbers, a blend


@dataclass(frozen=True, slots=True)
class Film:
    """A homogeneous layer of a coating or substrate stack.

    material: a name, a file, or { n, k }. thickness_um: of the layer.
    """

    material: Material
    thickness_um: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.thickness_um) and self.thickness_um >= 0):
            raise CellError(
                f"film thickness {self.thickness_um} um: need a finite value >= 0"
            )


@dataclass(frozen=True, slots=True)
class Layer:
    """One section of a layered pillar: a pedestal, the pillar itself, the residual mask
    on it.

    height_um: of the section. grow_um: its width less that of the mask, along every
    edge pair.
    material: of the section; None for that of the cell's pillar.
    between: around the section; None for the fill of the cell.
    coat_um, coat: a conformal film on its wall.
    """

    height_um: float
    grow_um: float = field(default=0.0, metadata={"signed": True})
    material: Material | None = None
    between: Material | None = None
    coat_um: float = 0.0
    coat: Material | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.height_um) and self.height_um > 0):
            raise CellError(
                f"layer height_um = {self.height_um}: need a finite length above 0"
            )
        if not (
            math.isfinite(self.grow_um)
            and math.isfinite(self.coat_um)
            and self.coat_um >= 0
        ):
            raise CellError(
                f"layer grow_um = {self.grow_um}, coat_um = {self.coat_um}: need finite lengths, coat >= 0"
            )
        if (self.coat_um > 0) != (self.coat is not None):
            raise CellError(
                f"layer coat_um = {self.coat_um} with coat = {self.coat!r}: need both or neither"
            )


@dataclass(frozen=True, slots=True)
class Cell:
    """One pillar; light comes from the substrate and leaves into the cover.

    pitch_um: lattice constant (along x).
    height_um: of the pillar.
    pillar, substrate, cover, between: materials. ``between`` fills the space around the
    pillar; None: the cover does, see :attr:`fill`.
    sidewall_rad: tilt of the wall from the vertical, above 0 where the foot is wider
    than the top; the
        diameter of a pillar is the one at half its height.
    under, over: films between substrate and pillar, and between pillar and cover, in
    the order that the
        light meets them.
    shape: of the section; its size is what other stages call the diameter.
    lattice: how the pillar repeats.
    layers: sections of the pillar, foot first, whose heights add up to ``height_um``;
    none: one section.
    """

    pitch_um: float
    height_um: float = 0.7
    pillar: Material = "a-Si"
    substrate: Material = "SiO2"
    cover: Material = "air"
    between: Material | None = None
    sidewall_rad: float = 0.0
    under: tuple[Film, ...] = ()
    over: tuple[Film, ...] = ()
    shape: Shape = field(default_factory=Circle)
    lattice: Lattice = field(default_factory=Lattice)
    layers: tuple[Layer, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.pitch_um) and self.pitch_um > 0):
            raise CellError(f"pitch_um = {self.pitch_um}: need a finite length above 0")
        if not (math.isfinite(self.height_um) and self.height_um >= 0):
            raise CellError(f"height_um = {self.height_um}: need a finite length >= 0")
        if not abs(self.sidewall_rad) < math.pi / 4:
            raise CellError(
                f"sidewall_rad = {self.sidewall_rad}: need an angle within +-pi/4"
            )
        total = sum(layer.height_um for layer in self.layers)
        if self.layers and abs(total - self.height_um) > 1e-9:
            raise CellError(
                f"layers add up to {total:.6g} um, height_um is {self.height_um:.6g}: need the same height"
            )

    @property
    def fill(self) -> Material:
        """Material around the pillar: ``between``, or the cover where none is stated."""
        return self.cover if self.between is None else self.between

    @property
    def round(self) -> bool:
        """Whether it is a plain round pillar on a square lattice, tilted wall and films
        allowed.
        """
        return (
            isinstance(self.shape, Circle)
            and not self.shape.hole
            and self.lattice.kind == "square"
            and not self.layers
        )

    @property
    def is_isotropic(self) -> bool:
        """Whether light along x and along y meets the same cell at normal incidence: a
        turn of less than half does.
        """
        turns = {"square": math.pi / 2, "hexagonal": math.pi / 3}
        if self.lattice.kind not in turns:
            return False
        outline = self.shape.outline(self.pitch_um / 2)
        step = turns[self.lattice.kind]
        return outline.repeats(step) or (
            self.lattice.centred and outline.repeats(2 * step)
        )

    @property
    def described(self) -> str:
        """Shape, lattice and layers in words."""
        layers = f" in {len(self.layers)} layers" if self.layers else ""
        return f"{self.shape.name}{' (hole)' if self.shape.hole else ''} on a {self.lattice.kind} lattice{layers}"

    @property
    def sections(self) -> tuple[Layer, ...]:
        """The layers, or the one section that the pillar is; none of a pillar without
        height.
        """
        if self.layers or not self.height_um:
            return self.layers
        return (Layer(self.height_um),)

    @property
    def materials(self) -> tuple[Material, ...]:
        """Of pillar, surroundings, films and layers with their coats."""
        films = [film.material for film in (*self.under, *self.over)]
        layered = [
            material
            for layer in self.layers
            for material in (layer.material, layer.between, layer.coat)
            if material is not None
        ]
        around = self.fill, self.substrate, self.cover
        return self.pillar, *around, *films, *layered

    @property
    def width_slope(self) -> float:
        """Change of width for each um of height, of tilted walls."""
        return -2 * math.tan(self.sidewall_rad)

    @property
    def tilted_sections(self) -> list[tuple[Layer, float]]:
        """Sections, foot first, with the widening at the middle of each by the tilted
        wall, um.
        """
        sections, foot = [], -self.height_um / 2
        for layer in self.sections:
            growth = self.width_slope * (foot + layer.height_um / 2)
            sections.append((layer, growth))
            foot += layer.height_um
        return sections

    @property
    def height_shares(self) -> tuple[float, ...]:
        """Share of each section in a change of the height.

        Sections of the pillar's own material share it in proportion to their heights.
        Other films (a pedestal, a residual mask) have no share, unless no section is of
        the pillar's material.
        """
        material_heights = [
            layer.height_um * (layer.material is None) for layer in self.sections
        ]
        material_heights = (
            material_heights
            if any(material_heights)
            else [layer.height_um for layer in self.sections]
        )
        return tuple(height / sum(material_heights) for height in material_heights)

    def at_height(self, height_um: float) -> "Cell":
        """The same cell with pillars of another height; of layered ones by
        :attr:`height_shares`.

        Raises:
            CellError: so low that nothing is left of the pillar's own material.
        """
        if not self.layers:
            return replace(self, height_um=height_um)
        own_um = sum(
            layer.height_um
            for layer, share in zip(self.layers, self.height_shares, strict=True)
            if share
        )
        change = height_um - self.height_um
        if own_um + change <= 0:
            raise CellError(
                f"height_um = {height_um:g} of a pillar in layers, {self.height_um - own_um:g} um of it of other films: "
                "need a larger height"
            )
        layers = tuple(
            replace(layer, height_um=layer.height_um + change * share)
            for layer, share in zip(self.layers, self.height_shares, strict=True)
        )
        return replace(self, height_um=height_um, layers=layers)

    def outline(self, size_um: float, *, grow_um: float = 0.0) -> Outline:
        """The section of a pillar of this size, wider by ``grow_um``."""
        return self.shape.outline(size_um, grow_um=grow_um)

    @property
    def widening_um(self) -> tuple[float, float]:
        """(least, most) that a section is wider than the size says: ends of a tilted
        wall, layers, their coats.
        """
        least, most = [], []
        for layer, growth in self.tilted_sections:
            width = layer.grow_um + growth
            half_um = abs(self.width_slope) * layer.height_um / 2
            least.append(width - half_um)
            most.append(width + half_um + 2 * layer.coat_um)
        return min(least, default=0.0), max(most, default=0.0)

    def widest_um(self, gap_um: float) -> float:
        """Largest size (um) that leaves this gap between neighbours; 0 if none does.

        Where a foot, a pedestal or a coat is wider than the size, it must also stay a
        fiftieth of the pitch from its neighbour.
        """
        _, most_widening = self.widening_um
        widening = most_widening if most_widening > 0 else -math.inf
        if self.round:
            return self.pitch_um - max(
                gap_um, NARROWEST_SHARE * self.pitch_um + widening
            )
        low, high = 0.0, 4 * self.pitch_um
        while high - low > 1e-4 * self.pitch_um:
            middle = (low + high) / 2
            is_clear = self.gap_um(middle) > gap_um and (
                widening < 0
                or self.gap_um(middle, grow_um=widening)
                > NARROWEST_SHARE * self.pitch_um
            )
            low, high = (middle, high) if is_clear else (low, middle)
        return round(low, 4)

    def size_um(self, width_um: float, gap_um: float = 0.0) -> float:
        """Least size (um) of the shape with every solid width (a ring's wall, a cross's
        bar) at least ``width_um``, and every hole and hollow at least ``gap_um``.

        Of a top or a layer that is thinner than the size, at least a fiftieth of the
        pitch remains.
        """
        least_widening, _ = self.widening_um
        width_um = max(
            width_um,
            NARROWEST_SHARE * self.pitch_um - least_widening
            if least_widening < 0
            else 0.0,
        )
        if self.round:
            return width_um
        unit = self.pitch_um / 2
        solid, space = self.outline(unit).spans_um
        return unit * max(width_um / solid, gap_um / space)

    def gap_um(self, size_um: float, *, grow_um: float = 0.0) -> float:
        """Least distance between neighbouring pillars of this size; 0 where they touch."""
        return self.outline(size_um, grow_um=grow_um).gap_um(
            self.lattice.steps_um(self.pitch_um)
        )
