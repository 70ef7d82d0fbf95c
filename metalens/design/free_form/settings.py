"""What a Fisher-designed lens is asked for: the table [fisher] of DESIGN.toml."""

from dataclasses import dataclass, field, fields
from typing import Literal

from metalens.core.errors import ConfigError
from metalens.design.profiles import Focus
from metalens.lens import reach

WINDOW = 42.4  # width of the PSFs in wavelength / NA
CLIMB = 2 / 3  # of that width, in the iterations of the search
FOCI = (0.29, 0.71)  # of the hyperbolic part: shares of the depth range in 1/z


@dataclass(frozen=True, slots=True)
class FisherSettings:
    """What a Fisher-designed lens is asked for.

    depths_mm: range of the source; left out, from 1.75 waves out of focus at the rim on
        one side of the design's source distance to as many on the other.
    angles_deg: field angles that the lens is made for, each in every direction; the
        energy is held at all of them, and the information of each counts equally.
    pixel_um: pixels that the information is read with: the sensor's pitch, or 2 or 3
        times it for 2 x 2 or 3 x 3 binning; left out, 0.88 wavelength / NA.
    encircled: least share of the light inside ``radius_um`` of the axis, at every
        depth; 0 leaves it free.
    radius_um: left out, 5.3 wavelength / NA.
    focus_mm: (least, largest) source distance of the hyperbolic part; starts are spread
        between them. Left out, the middle two fifths of the depths, in 1/z.
    controls: spline control points across the aperture in the first eleventh of the
        iterations; after it every node of the pupil (a cell of about 6 um) is free,
        which sends light away best where the energy allows it.
    iterations: of both stages. starts: tried.
    spread_rad: deviation of the random start.
    even: 1 climbs the mean of the logarithm of I(z) over the depths (even over depth),
        0 the logarithm of its mean.
    normalisation: of Eq. 11. seed: of starts and positions.
    """

    depths_mm: tuple[float, float] | None = None
    angles_deg: tuple[float, ...] = (0.0,)
    pixel_um: float | None = None
    encircled: float = 0.5
    radius_um: float | None = None
    focus_mm: tuple[float, float] | None = None
    controls: int = 16
    iterations: int = 800
    starts: int = 3
    spread_rad: float = field(default=3.0, metadata={"signed": False})
    even: float = 0.1
    normalisation: Literal["sum", "l2"] = "l2"
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse settings out of range.

        Raises:
            ConfigError: naming the setting and what is needed.
        """
        if self.depths_mm is not None and not 0 < self.depths_mm[0] < self.depths_mm[1]:
            raise ConfigError(f"depths_mm = {self.depths_mm}: need 0 < least < largest")
        if self.focus_mm is not None and not 0 < self.focus_mm[0] <= self.focus_mm[1]:
            raise ConfigError(f"focus_mm = {self.focus_mm}: need 0 < least <= largest")
        if not self.angles_deg or not all(0 <= a <= 40 for a in self.angles_deg):
            raise ConfigError(
                f"angles_deg = {self.angles_deg}: need at least one field angle of 0 to 40 degrees"
            )
        lengths = [
            1.0 if length is None else length
            for length in (self.radius_um, self.pixel_um)
        ]
        if not 0 <= self.encircled < 1 or not min(lengths) > 0:
            raise ConfigError(
                f"encircled = {self.encircled}, radius_um = {self.radius_um}, pixel_um = {self.pixel_um}: need a share "
                "below 1, and a radius and pixels above 0"
            )
        if self.starts < 1 or self.iterations < 1 or self.controls < 4:
            raise ConfigError(
                f"starts, iterations = {self.starts}, {self.iterations}: need 1 or "
                f"more; controls = {self.controls}: need 4 or more"
            )

    def about(self, focus: Focus, radius_um: float) -> "ResolvedFisherSettings":
        """Settings for one lens, with its depths, foci and disc where they were left
        out.

        Args:
            focus: wavelength, distances and films of the lens.
            radius_um: radius of its aperture, um.

        Raises:
            ConfigError: pixels larger than the window of this lens.
        """
        lens = reach.ApertureSummary(
            radius_um,
            focus.wavelength_um,
            focus.sensor_distance_um,
            focus.source_distance_um,
            focus.layers,
        )
        if self.depths_mm:
            near, far = (1e3 * z for z in self.depths_mm)
        else:
            near, far = reach.depth_range_um(lens)
        pixel = self.pixel_um or reach.pixel_um(lens)
        window = reach.window_um(lens, (near, far), airy=WINDOW)
        climb_window = CLIMB * window
        if 3 * pixel > climb_window:
            raise ConfigError(
                f"pixel_um = {pixel}: need at most {climb_window / 3:.3g} um for a lens whose spots are seen in a "
                f"window of {climb_window:g} um"
            )
        values = {f.name: getattr(self, f.name) for f in fields(self)} | {
            "depths_mm": (near * 1e-3, far * 1e-3),
            "radius_um": self.radius_um or reach.disc_um(lens),
            "focus_mm": self.focus_mm or between_mm((near, far), *FOCI),
            "pixel_um": pixel,
            "sample_um": reach.sample_um(lens, pixel),
            "step_um": reach.depth_step_um(lens, near),
            "window_um": window,
            "climb_window_um": climb_window,
        }
        return ResolvedFisherSettings(**values)


@dataclass(frozen=True, slots=True)
class ResolvedFisherSettings(FisherSettings):
    """A :class:`FisherSettings` with nothing left to the lens: what a search climbs,
    and what
    its results are judged by.

    window_um, climb_window_um: widths of the PSFs. sample_um: of their intensities.
    step_um: of the difference in
    Eq. 11.
    """

    depths_mm: tuple[float, float] = field(kw_only=True)
    pixel_um: float = field(kw_only=True)
    radius_um: float = field(kw_only=True)
    focus_mm: tuple[float, float] = field(kw_only=True)
    window_um: float = field(kw_only=True)
    climb_window_um: float = field(kw_only=True)
    sample_um: float = field(kw_only=True)
    step_um: float = field(kw_only=True)

    def about(self, focus: Focus, radius_um: float) -> "ResolvedFisherSettings":
        """Itself."""
        return self


def between_mm(
    depths_um: tuple[float, float], first: float, last: float
) -> tuple[float, float]:
    """Depths in mm at two shares of a depth range in 1/z, rounded to 2 digits, in
    order.

    Share 0 is the near end, 1 the far end, below 0 nearer still. Limited to ten times
    the far depth.

    Args:
        depths_um: near and far source depth from the lens, um.
        first: share of the first depth.
        last: share of the second depth.
    """
    near, far = (1e3 / z for z in depths_um)
    ends = (1 / max(near + share * (far - near), 0.1 * far) for share in (first, last))
    low, high = (float(f"{z:.2g}") for z in ends)
    return low, high
