"""What a Fisher-designed lens is asked for: the table [fisher] of DESIGN.toml."""

from dataclasses import dataclass
from typing import Literal

from metalens.errors import ConfigError

SAMPLE_UM = 0.75  # of the intensities that the information is read from


@dataclass(frozen=True, slots=True)
class Fisher:
    """What a Fisher-designed lens is asked for.

    depths_mm: range of the source. pixel_um: pixels that the information is read with; give 2 or 3 times the sensor's
        pitch for 2 x 2 or 3 x 3 binning.
    encircled: least share of the light inside ``radius_um`` of the axis, at every depth; 0 leaves it free.
    focus_mm: (least, largest) source distance of the hyperbolic part; starts are spread between them.
    grids: control points across the aperture, stage by stage. iterations: of every stage. starts: tried.
    zones: rings of the double helix that the starts begin from, in turn; 0 for none.
    spread_rad: deviation of the random start (a tenth of it on a double helix).
    even: 1 climbs the mean of the logarithm of I(z) over the depths (even over depth), 0 the logarithm of its mean.
    normalisation: of Eq. 11. seed: of starts and positions.
    """

    depths_mm: tuple[float, float] = (16.0, 26.0)
    pixel_um: float = 3.0
    encircled: float = 0.5
    radius_um: float = 18.0
    focus_mm: tuple[float, float] = (18.0, 22.0)
    grids: tuple[int, ...] = (8, 14, 24)
    iterations: int = 60
    starts: int = 2
    zones: tuple[int, ...] = (2, 0)
    spread_rad: float = 3.0
    even: float = 0.3
    normalisation: Literal["sum", "l2"] = "l2"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.depths_mm[0] < self.depths_mm[1]:
            raise ConfigError(f"depths_mm = {self.depths_mm}: need 0 < least < largest")
        if not 0 <= self.encircled < 1 or not self.radius_um > 0 or not self.pixel_um >= 3 * SAMPLE_UM:
            raise ConfigError(
                f"encircled = {self.encircled}, radius_um = {self.radius_um}, pixel_um = {self.pixel_um}: need a share "
                f"below 1, a radius above 0, and pixels of at least {3 * SAMPLE_UM} um"
            )
        if self.starts < 1 or self.iterations < 1 or not self.grids or min(self.grids) < 4:
            raise ConfigError(
                f"starts, iterations = {self.starts}, {self.iterations}: need 1 or more; grids of 4 or more"
            )
