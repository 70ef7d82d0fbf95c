"""Which frames are predicted: depths, angles, exposures, window, groups; where the
source stood, and its spectrum.
"""

import dataclasses
import functools
import math
from dataclasses import dataclass

import numpy as np

from characterize.model.compressed import CompressedLens
from characterize.model.glass import FilmStack
from characterize.model.parameters import PLACE
from characterize.model.pillars import PillarResponse
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import CDError, WavefrontError, derivative_maps, names_of_kind
from metalens.lens import Lens

LEAST_NM = (
    0.02  # of a spectrum that colours are chosen for: none has no slope by its width
)
_RIM, _TURN_STEP, _MOST_COLOURS = 48, 0.05, 64


@dataclass(frozen=True, eq=False, slots=True)
class FrameSetting:
    """The frames that are to be predicted.

    depth_um: (n,) stated source depths. angle_rad: (n, 2). exposure: (n,) relative.
    pixel_um: of the sensor; rows, columns: of the window about the chief ray.
    margin: pixels around it that blur may reach in from. fill: width of a pixel over
    the pitch.
    tolerance: relative error of the field allowed to the reduction.
    dark_known: the dark level is subtracted, so that the background is light and grows
    with the exposure.
    """

    depth_um: Array
    angle_rad: Array
    exposure: Array
    pixel_um: float
    rows: int
    columns: int
    margin: int = 4
    tolerance: float = 5e-4
    fill: float = 1.0
    dark_known: bool = True

    def __post_init__(self) -> None:
        if not (np.isfinite(self.depth_um).all() and (self.depth_um > 0).all()):
            raise FitError(
                "source depths must be finite and above 0; give them in stage.csv (depth_um)"
            )

    @property
    def edges(self) -> tuple[Array, Array]:
        """(rows, 1) and (1, columns) of the pixels, -1 to 1 from edge to edge."""
        y, x = (
            (np.arange(n) - (n - 1) / 2) / (n / 2) for n in (self.rows, self.columns)
        )
        return y[:, None], x[None]

    @property
    def glow(self) -> Array:
        """(n, 1, 1) background of every frame over that of exposure 1; what nobody
        subtracted is equal in all.
        """
        return np.where(self.dark_known, self.exposure, 1.0)[:, None, None]


def true_depth(x: Array, stated: Array, centre_um: float) -> Array:
    """(n,) source depths after stage zero and scale, um.

    stated + zero + scale (stated - centre), at least 0.2 of the stated depth.

    Args:
        x: all parameters.
        stated: (n,) depths, um.
        centre_um: middle of the stage, um.
    """
    depth = (
        stated
        + x[PLACE["stage_zero_um"]]
        + x[PLACE["stage_scale"]] * (stated - centre_um)
    )
    return np.asarray(np.maximum(depth, 0.2 * stated))


def background_planes(x: Array, setting: FrameSetting) -> Array:
    """(n, rows, columns) electrons of the background, a plane in every frame.

    Args:
        x: all parameters, in the order of ``PARAMETERS``.
        setting: depths, angles and window of the frames.
    """
    edge_y, edge_x = setting.edges
    along = x[PLACE["background_x_e"]] * edge_x + x[PLACE["background_y_e"]] * edge_y
    return np.asarray(setting.glow * (x[PLACE["background_e"]] + along))


LIGHT = ("light_x", "light_y", "light_r")


def light_maps(u: Array, v: Array) -> Array:
    """(3, *shape) ln of the irradiance at lens places over the radius, for one unit of
    each of ``LIGHT``.

    Args:
        u: x on the lens over its radius.
        v: y on the lens over its radius.
    """
    return np.stack([u, v, u * u + v * v - 0.5])


@dataclass(frozen=True, eq=False, slots=True)
class AngleGroup:
    """Frames of one field angle, and the lens on nodes for it.

    index: of the frames. phase_maps: {name: (q, p) phase on the nodes for one unit of a
    parameter, rad; imaginary parts attenuate}. cd_maps: (m, q, p) diameters by CD
    parameters.
    shaded_parts: behind a stop the same frames in parts of equal shadow; where the stop
    is not at the pillars, one part for each depth.
    """

    index: Array
    pillars: PillarResponse
    reduced: CompressedLens
    phase_maps: dict[str, Array]
    cd_maps: Array
    shaded_parts: tuple["AngleGroup", ...] = ()

    @property
    def illuminated_parts(self) -> tuple["AngleGroup", ...]:
        """Groups whose frames meet the same pillars."""
        return self.shaded_parts or (self,)

    @classmethod
    def of(
        cls, index: Array, pillars: PillarResponse, reduced: CompressedLens
    ) -> "AngleGroup":
        """With the phases of wave-front parameters and of uneven illumination."""
        u, v = reduced.u, reduced.v
        names = *names_of_kind(WavefrontError), *LIGHT
        maps = *derivative_maps(WavefrontError, u, v), *(-0.5j * light_maps(u, v))
        phases = dict(zip(names, maps, strict=True))
        return cls(index, pillars, reduced, phases, derivative_maps(CDError, u, v))

    def shaded(self, lens: Lens, depth_um: Array) -> "AngleGroup":
        """The group behind the lens' stop, in parts of frames with equal shadows.

        Args:
            depth_um: (frames,) source depths of all frames of the model.
        """
        if lens.layers.stop is None:
            return self
        at = depth_um[self.index]
        # frames with equal shadows: all, where the stop is at the pillars
        equal = (
            [at == z for z in np.unique(at)]
            if lens.layers.stop.distance_um
            else [slice(None)]
        )
        shaded_parts = tuple(
            dataclasses.replace(
                self,
                index=self.index[some],
                reduced=self.reduced.shaded(lens, self.pillars, float(at[some][0])),
                shaded_parts=(),
            )
            for some in equal
        )
        return dataclasses.replace(self, shaded_parts=shaded_parts)

    def only(self, frames: Array) -> "AngleGroup | None":
        """The group of some frames, renumbered in rising order; None without any."""
        place = np.flatnonzero(np.isin(frames, self.index))
        if not len(place):
            return None
        parts = [part.only(frames) for part in self.shaded_parts]
        shaded_parts = tuple(part for part in parts if part is not None)
        return dataclasses.replace(self, index=place, shaded_parts=shaded_parts)

    def with_phases(self, maps: dict[str, Array]) -> "AngleGroup":
        """With further phase maps; shaded parts have the same nodes."""
        return dataclasses.replace(
            self,
            phase_maps=self.phase_maps | maps,
            shaded_parts=tuple(part.with_phases(maps) for part in self.shaded_parts),
        )


@dataclass(frozen=True, slots=True)
class SpectralLine:
    """A Gaussian line as the fewest colours that stand for it to a lens.

    Intensities turn with the wavelength as the paths through the lens differ: by up to
    t = 2 pi path sigma over
    wavelength² in a standard deviation sigma of the line, and no faster.

    path_um: largest difference in optical path between two parts of the lens.
    wavelength_um: of the design.
    tolerance: of the mean of exp(i s) over the line, exp(-s²/2), for every s up to t.
    """

    path_um: float
    wavelength_um: float
    tolerance: float

    @classmethod
    def of(
        cls, lens: Lens, depth_um: Array, angle_rad: Array, *, tolerance: float
    ) -> "SpectralLine":
        """The line's largest path difference through a lens.

        Paths from the sources by axis and rim to the chief rays' places, through films
        as through equivalent air. One wavelength is added for the pillars.

        Args:
            depth_um: (n,) of the sources.
            angle_rad: (n, 2) their field angles.
            tolerance: of the mean of phasors over the line.
        """
        turn = np.linspace(0, 2 * math.pi, _RIM, endpoint=False)
        x, y = (
            np.append(lens.diameters.radius_um * part, 0.0)
            for part in (np.cos(turn), np.sin(turn))
        )
        z = FilmStack.of(lens.layers, lens.wavelength_um).apparent_um(depth_um[:, None])
        d = lens.reduced_um
        tx, ty = np.tan(angle_rad.T)[..., None]
        paths = np.sqrt((x + z * tx) ** 2 + (y + z * ty) ** 2 + z**2)
        paths = paths + np.sqrt((x - d * tx) ** 2 + (y - d * ty) ** 2 + d**2)
        return cls(
            float(np.ptp(paths, axis=1).max()) + lens.wavelength_um,
            lens.wavelength_um,
            tolerance,
        )

    def colours(
        self, bandwidth_nm: float, like_nm: float | None = None
    ) -> list[tuple[float, float]]:
        """(offset in nm, weight) of the samples of a line; one for no width.

        Gauss-Hermite nodes, or even ones of Gaussian weight, which are fewer where the
        phase in one standard deviation is above 2 rad.

        Args:
            bandwidth_nm: standard deviation of the line.
            like_nm: another width by which the number is chosen: for differences.

        Raises:
            FitError: more than 64 colours would be needed.
        """
        if bandwidth_nm <= 0:
            return [(0.0, 1.0)]
        wide_nm = max(bandwidth_nm if like_nm is None else like_nm, LEAST_NM)
        turn = 2 * math.pi * self.path_um * wide_nm * 1e-3 / self.wavelength_um**2
        turn = math.ceil(turn / _TURN_STEP) * _TURN_STEP
        place, weight = _colours(turn, self.tolerance)
        return list(zip((bandwidth_nm * place).tolist(), weight.tolist(), strict=True))


@functools.lru_cache(maxsize=64)
def _colours(turn: float, tolerance: float) -> tuple[Array, Array]:
    """(n,) offsets in standard deviations, and weights of sum 1, of the fewest samples.

    Their mean of cos(s x) is exp(-s²/2), that of the Gaussian line, to ``tolerance``
    for every s up to ``turn``, rad.

    Raises:
        FitError: more than ``_MOST_COLOURS`` would be needed.
    """
    s = np.linspace(0, turn, 129)
    for count in range(2, _MOST_COLOURS + 1):
        for place, weight in (
            np.polynomial.hermite_e.hermegauss(count),
            _even(count, turn),
        ):
            weight = weight / weight.sum()
            mean = weight @ np.cos(place[:, None] * s)
            if np.abs(mean - np.exp(-(s**2) / 2)).max() <= tolerance:
                return place, weight
    raise FitError(
        f"a spectrum so wide that light turns by {turn:.0f} rad against itself in one standard deviation needs more "
        f"than {_MOST_COLOURS} colours; put a narrower filter before the lens"
    )


def _even(count: int, turn: float) -> tuple[Array, Array]:
    """(count,) even offsets in standard deviations, and their Gaussian weights.

    The error of truncation at the ends r, exp(-r²/2), equals that of the steps h,
    exp(-(2 pi / h - t)² / 2) at t = ``turn``, where r = 2 pi / h - t.
    """
    step = (math.hypot(turn, math.sqrt(4 * math.pi * (count - 1))) - turn) / (count - 1)
    place = step * (np.arange(count) - (count - 1) / 2)
    return place, np.exp(-(place**2) / 2)
