"""What a Fisher-designed lens is asked for: the table [fisher] of DESIGN.toml."""

from dataclasses import dataclass, field
from typing import Literal

from metalens.ground.errors import ConfigError

SAMPLE_UM = 0.75  # of the intensities that the information is read from


@dataclass(frozen=True, slots=True)
class Variation:
    """What the process may do to the lens; the design is made to stand plus and minus these.

    phase: relative error of every pillar's phase within its turn (height, index, or a bias of the diameters).
    distance_um: error of the lens-to-sensor distance.
    """

    phase: float = 0.0
    distance_um: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.phase < 0.5 and 0 <= self.distance_um < 500):
            raise ConfigError(
                f"variation of phase = {self.phase}, distance_um = {self.distance_um}: need 0 to 0.5 and 0 to 500"
            )


@dataclass(frozen=True, slots=True)
class Fisher:
    """What a Fisher-designed lens is asked for.

    objective: axial (I(z) of Eq. 11 of a point), or scenes (Eq. 6 on rendered triplets of eyes).
    depths_mm: range of the source. angles_deg: field angles that the lens is made for, each in every direction; the
        energy is held at all of them, and the information of each counts alike.
    pixel_um: pixels that the information is read with; give 2 or 3 times the sensor's pitch for 2 x 2 or 3 x 3 binning.
    encircled: least share of the light inside ``radius_um`` of the axis, at every depth; 0 leaves it free.
    focus_mm: (least, largest) source distance of the hyperbolic part; starts are spread between them.
    grids: control points across the aperture, stage by stage; 0 as the last for one free value a node of the pupil
        (cells of about 6 um), which sends light away best where the energy allows it.
    iterations: of all stages, shared in proportion to their grids. starts: tried.
    zones: rings of the double helix that the starts begin from, in turn; 0 for none.
    spread_rad: deviation of the random start (a tenth of it on a double helix).
    even: 1 climbs the mean of the logarithm of I(z) over the depths (even over depth), 0 the logarithm of its mean.
    normalisation: of Eq. 11. seed: of starts and positions.
    refine: iterations of NLopt's constrained method of moving asymptotes (MMA) after the last stage.
    variation: of the process; 0 leaves it out.
    scenes: of the objective of that name. orthogonality: its weight lambda in Eq. 6, of the squared cosine of the
        span angle.
    """

    objective: Literal["axial", "scenes"] = "axial"
    depths_mm: tuple[float, float] = (16.0, 26.0)
    angles_deg: tuple[float, ...] = (0.0,)
    pixel_um: float = 3.0
    encircled: float = 0.5
    radius_um: float = 18.0
    focus_mm: tuple[float, float] = (18.0, 22.0)
    grids: tuple[int, ...] = (16, 0)
    iterations: int = 800
    starts: int = 3
    zones: tuple[int, ...] = (0,)
    spread_rad: float = field(default=3.0, metadata={"signed": False})
    even: float = 0.1
    normalisation: Literal["sum", "l2"] = "l2"
    seed: int = 0
    refine: int = 0
    variation: Variation = field(default_factory=Variation)
    scenes: int = 6
    orthogonality: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.depths_mm[0] < self.depths_mm[1]:
            raise ConfigError(f"depths_mm = {self.depths_mm}: need 0 < least < largest")
        if not self.angles_deg or not all(0 <= a <= 40 for a in self.angles_deg):
            raise ConfigError(f"angles_deg = {self.angles_deg}: need at least one field angle of 0 to 40 degrees")
        if not 0 <= self.encircled < 1 or not self.radius_um > 0 or not self.pixel_um >= 3 * SAMPLE_UM:
            raise ConfigError(
                f"encircled = {self.encircled}, radius_um = {self.radius_um}, pixel_um = {self.pixel_um}: need a share "
                f"below 1, a radius above 0, and pixels of at least {3 * SAMPLE_UM} um"
            )
        fine = (*self.grids[:-1], self.grids[-1] or 4) if len(self.grids) > 1 else self.grids
        if self.starts < 1 or self.iterations < 1 or not fine or min(fine) < 4:
            raise ConfigError(
                f"starts, iterations = {self.starts}, {self.iterations}: need 1 or more; grids = {self.grids}: need 4 "
                "or more each, or 0 as the last of several"
            )
        if self.refine < 0 or self.scenes < 1 or self.orthogonality < 0 or not self.zones:
            raise ConfigError(
                f"refine = {self.refine}, scenes = {self.scenes}, orthogonality = {self.orthogonality}, zones = "
                f"{self.zones}: need 0 or more, 1 or more, 0 or more, and at least one entry"
            )
