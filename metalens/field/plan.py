"""Which field points, depths and wavelengths an image needs: tried on one line through
the field, cheapest first.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from metalens.field import compiled
from metalens.field.left_out import Judged, folded, neglected, polarised
from metalens.field.patches import dense, relative, together
from metalens.field.points import Optics, Window, psfs
from metalens.field.waves import PillarWave
from metalens.ground.errors import SceneError
from metalens.ground.threads import apart
from metalens.psf import Nodes, Polarisation, Source
from metalens.psf import spectrum as spectra

STEPS = (
    24,
    16,
    12,
    8,
    6,
    4,
)  # between depths that are tried, in 96ths of the range of 1/z
FINE = 96
ALONG = 192  # steps of an axis of the field, on which its nodes lie
MOST = 57  # nodes along an axis
DENSER = (
    0.0,
    2.0,
)  # by how much more the nodes lie at the rim of the field than on the axis
LONGEST = 4.0  # period of the nodes, in windows, from which on none is longer
LONGER = 2**0.25  # by which one is than the next; nodes grow with its square
OFF_AXIS = (
    (0.75, 0.45),
    (-0.3, 0.8),
)  # places (x, y) in half fields, well off the middle
# two in each quarter, a fifth of either axis apart at most, out to the rims, where a
# blur is widest and the more light
# is folded back
STREWN = tuple(
    zip(
        (-0.95, -0.7, -0.45, -0.2, 0.2, 0.45, 0.7, 0.95),
        (-0.3, 0.6, -0.85, 0.1, -0.55, 0.95, 0.35, -0.75),
        strict=True,
    )
)
# power of their distance by which the error falls; more would need PSFs without edges
ORDER = 2.5
SHARES = {  # of the tolerance; together all of it
    "kernels": 0.6,
    "field": 0.4,
    "depth": 0.3,
    "spectrum": 0.4,
    "transform": 0.36,
    "polarisation": 0.2,
    "folded": 0.24,
}


@dataclass(frozen=True, slots=True)
class Grid:
    """Where a scene is sampled: as :class:`metalens.image.Frames` has it, upright on
    the sensor.

    samples: (y, x) of the image that is returned. step_um: of the samples on the
    sensor.
    margin: samples around them that are rendered too, blurred in, and not returned.
    depths_um: (least, largest) that the scene holds, inf for what is far away.
    window: samples of a PSF along an axis, odd.

    A sample at (x, y) um from the axis shows the direction whose tangents are (x, y) /
    reduced distance, the sum of
    thickness / index from lens to sensor (without films the lens-sensor distance).
    """

    samples: tuple[int, int]
    step_um: float
    depths_um: tuple[float, float]
    margin: int = 0
    window: int = 33

    def __post_init__(self) -> None:
        near, far = self.depths_um
        if not (min(self.samples) >= 1 and self.step_um > 0 and self.margin >= 0):
            raise SceneError(f"{self}: need samples >= 1, step above 0 and margin >= 0")
        if not 0 < near <= far:
            raise SceneError(
                f"depths {self.depths_um} um: need 0 < least <= largest (inf for what is far away)"
            )

    @property
    def spare(self) -> int:
        """Samples that are continued beyond the rendered ones, so that no PSF ends at
        the border.
        """
        return max(self.window // 2 - self.margin, 0)

    @property
    def frame(self) -> tuple[int, int]:
        """(y, x) samples on which sources may lie: image, margin and spare."""
        return self.samples[0] + 2 * (self.margin + self.spare), self.samples[1] + 2 * (
            self.margin + self.spare
        )

    @property
    def half_um(self) -> list[float]:
        """[y, x] from the middle of the frame to its last sample: how far the field
        reaches.
        """
        return [(n - 1) / 2 * self.step_um for n in self.frame]


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Nodes of a field of PSFs.

    y_um, x_um: rows and columns of the nodes on the sensor, from the first to the last
    sample.
    depths_um: ascending, at equal steps of 1/z. waves: wavelengths and weights. window:
    of the PSFs.
    folds: whether the lens is round and the grid on its axis, so that one eighth of the
    nodes gives all.
    """

    y_um: Tensor
    x_um: Tensor
    depths_um: Tensor
    waves: Nodes
    window: Window
    folds: bool


def planned(
    optics: Optics,
    grid: Grid,
    source: Source | spectra.Measured | Nodes,
    middle_um: tuple[float, float],
    *,
    tolerance: float,
    folds: bool,
    polarisation: Polarisation = "auto",
) -> Plan:
    """The fewest nodes that interpolate the PSFs within their shares of the tolerance.

    Tried on a line across the field (at 0.6 of its half height), whose points in
    between judge every candidate, for
    the nearest, the middle and the farthest depth. A whole spectrum is used from the
    start, coarse for the line. Of the
    field one scalar is taken where its error (:func:`unpolarised`) is below the
    tolerance, else as many components of
    both polarisations as their share asks for, as ``polarisation`` says.

    Raises:
        SceneError: tolerance not above 0, or not met with ``MOST`` nodes along an axis.
    """
    if not 0 < tolerance < 1:
        raise SceneError(f"tolerance {tolerance}: need 0 < tolerance < 1")
    window, half = Window(grid.window, grid.step_um), grid.half_um
    waves = waves_of(
        optics, grid, source, middle_um, half, tolerance * SHARES["spectrum"]
    )
    coarse = waves if isinstance(source, Nodes) else _coarse(optics, source, 2)
    ends = depth_nodes(grid, 3)
    window = _unfolded(
        optics,
        coarse,
        window,
        (_places(STREWN, middle_um, half), ends),
        tolerance * SHARES["folded"],
    )

    def across(places: Tensor) -> Tensor:
        at = torch.stack(
            [
                (2 * places / ALONG - 1) * half[1],
                torch.full_like(places, 0.6 * half[0]),
            ],
            -1,
        )
        return spectral(
            optics,
            at + torch.tensor(middle_um, dtype=torch.float64),
            ends,
            coarse,
            window,
        )

    def deep(places: Tensor) -> Tensor:
        at = _places(((0.0, 0.0), (0.7, -0.4)), middle_um, half)
        near, far = (1 / d for d in grid.depths_um)
        return spectral(
            optics, at, 1 / (near + (far - near) * places / FINE), coarse, window
        ).transpose(0, 1)

    count, denser = _line(across, (middle_um[0], half[1]), tolerance * SHARES["field"])
    depths = (
        1
        if grid.depths_um[0] == grid.depths_um[1]
        else _fewest(deep, tolerance * SHARES["depth"], "depths")
    )
    aside = _places(OFF_AXIS, middle_um, half), ends
    if (
        neglected(Judged(optics, coarse, window, aside))
        > tolerance * SHARES["transform"]
    ):
        window = replace(window, curved=True)
    some = _places((*OFF_AXIS, (0.0, 0.0)), middle_um, half), ends
    most = tolerance * SHARES["polarisation"]
    window = polarised(
        Judged(optics, coarse, window, some), polarisation, within=(tolerance, most)
    )
    y, x = (
        m
        + (
            2
            * placed(max(2, math.ceil((count - 1) * h / half[1]) + 1), denser, (m, h))
            / ALONG
            - 1
        )
        * h
        for m, h in zip(middle_um[::-1], half, strict=True)
    )
    return Plan(
        y, x, depth_nodes(grid, depths), waves, window, folds and half[0] == half[1]
    )


def depth_nodes(grid: Grid, count: int) -> Tensor:
    """(count,) depths ascending, at equal steps of 1/z."""
    near, far = grid.depths_um
    return 1 / torch.linspace(1 / near, 1 / far, count, dtype=torch.float64)


def spectral(
    optics: Optics, at_um: Tensor, depths_um: Tensor, waves: Nodes, window: Window
) -> Tensor:
    """(points, depths, h, w) PSFs summed over the spectrum; light of each wavelength
    with its weight.
    """
    pairs = list(
        zip(waves.wavelengths_um.tolist(), waves.weights.tolist(), strict=True)
    )
    about = {
        "depths_um": depths_um,
        "window": window,
        "finest_um": min(wave for wave, _ in pairs),
    }

    def of(place: Tensor) -> Tensor:  # all wavelengths of a point share its rays
        total = torch.zeros(())
        for wave, weight in pairs:
            total = total + weight * psfs(optics, place, wavelength_um=wave, **about)
        return total

    first, *others = at_um.unsqueeze(1)
    found = [of(first)] + [torch.empty(0)] * len(others)

    def some(start: int, stop: int) -> None:
        for i in range(start, stop):
            found[i + 1] = of(others[i])

    if compiled.plain(found[0]):
        apart(len(others), torch.no_grad()(some))
    else:  # derivatives, or another device
        some(0, len(others))
    return torch.cat(found)


def _unfolded(
    optics: Optics,
    waves: Nodes,
    window: Window,
    at: tuple[Tensor, Tensor],
    tolerance: float,
) -> Window:
    """The window with nodes of the least period that folds no more light back than is
    tolerated, or of the longest.
    """
    while (
        window.period < LONGEST
        and folded(Judged(optics, waves, window, at)) > tolerance
    ):
        window = replace(window, period=LONGER * window.period)
    return window


def _places(
    units: tuple[tuple[float, float], ...],
    middle_um: tuple[float, float],
    half_um: list[float],
) -> Tensor:
    """(places, [x, y]) of a field, given in its half widths."""
    middle, half = (
        torch.tensor(pair, dtype=torch.float64) for pair in (middle_um, half_um[::-1])
    )
    return middle + half * torch.tensor(units, dtype=torch.float64)


def waves_of(
    optics: Optics,
    grid: Grid,
    source: Source | spectra.Measured | Nodes,
    middle_um: tuple[float, float],
    half_um: list[float],
    tolerance: float,
) -> Nodes:
    """As few wavelengths of a source as image within the tolerance at three places; a
    given rule is kept as it is.
    """
    if isinstance(source, Nodes):
        return source
    at = torch.tensor([[0.0, 0.0], [0.5, 0.3], [0.9, 0.8]], dtype=torch.float64)
    at = at * torch.tensor(
        [half_um[1], half_um[0]], dtype=torch.float64
    ) + torch.tensor(middle_um, dtype=torch.float64)
    ends, window = depth_nodes(grid, 2), Window(grid.window, grid.step_um)
    last = spectral(optics, at, ends, _coarse(optics, source, 1), window)
    beside = source.beside if isinstance(source, spectra.Measured) else 0.0
    for count in range(2, 17):
        made = _coarse(optics, source, count)
        found = spectral(optics, at, ends, made, window)
        light = found.sum((-1, -2))
        error = float(
            (relative(last, found) * light / light.amax(0)).max()
        )  # of the image, where that is dark too
        if error + beside <= tolerance:  # of the rule before; this one is finer
            return replace(_coarse(optics, source, count - 1), error=error + beside)
        last = found
    raise SceneError(
        f"16 wavelengths leave {error:.2g} of the image, above {tolerance:.2g}: raise the tolerance"
    )


def _coarse(optics: Optics, source: Source | spectra.Measured, count: int) -> Nodes:
    """So many wavelengths of a spectrum, which the lens's pillars are known for."""
    made = Nodes(*spectra.gauss(*spectra.points(source), count), np.nan)
    if not isinstance(optics.wave, PillarWave):
        return made
    return spectra.known(made, source, optics.wave.lens.proxy.wavelengths_um)


def placed(count: int, denser: float, span: tuple[float, float]) -> Tensor:
    """(nodes,) places 0 … ALONG of an axis, whole numbers: so many, denser with their
    distance X from the lens axis.

    The density is 1 + denser |X| / largest |X|: astigmatism moves the edges of a PSF by X², coma by X.

    Args:
        span: middle and half length of the axis in um.
    """
    x = span[0] + np.linspace(-1, 1, 8 * ALONG + 1) * span[1]
    rim = max(np.abs(x).max(), 1e-9)
    passed = x / rim + denser / 2 * (x / rim) * np.abs(x / rim)
    even = np.linspace(passed[0], passed[-1], min(count, ALONG + 1))
    place = (
        np.rint((np.interp(even, passed, x) - span[0]) / span[1] * (ALONG / 2))
        if span[1]
        else np.zeros(1)
    )
    return torch.from_numpy(np.unique(place) + ALONG / 2)


DARK = (
    "a PSF has no light within its window at some place, depth or wavelength of the scene: a frame that reaches to "
    "80 degrees of field or beyond (take fewer or smaller samples), or a margin narrower than the blur"
)


class _Known:
    """PSFs at whole places of a line, of sum 1, and their light, each computed once."""

    def __init__(self, at: Callable[[Tensor], Tensor]) -> None:
        self.at, self.kept = at, dict[int, tuple[Tensor, Tensor]]()

    def error(self, nodes: list[int]) -> float:
        """Of the image of even radiance, by interpolation half-way between the nodes,
        at the worst depth.
        """
        between = sorted(
            {(a + b) // 2 for a, b in itertools.pairwise(nodes)} - set(nodes)
        )
        (want, bright), given = self.psfs(between), self.psfs(nodes)
        weights = dense(
            *(torch.tensor(places, dtype=torch.float64) for places in (between, nodes))
        ).to(want)
        got, light = (torch.tensordot(weights, part, 1) for part in given)
        return together(got * light[..., None, None], want * bright[..., None, None])

    def psfs(self, places: list[int]) -> tuple[Tensor, Tensor]:
        """(places, depths, h, w) and (places, depths)."""
        missing = [i for i in places if i not in self.kept]
        if missing:
            found = self.at(torch.tensor(missing, dtype=torch.float64))
            light = found.sum((-1, -2))
            if not bool((light > 0).all()):
                raise SceneError(DARK)
            self.kept.update(
                zip(
                    missing,
                    zip(found / light[..., None, None], light, strict=True),
                    strict=True,
                )
            )
        psfs, lights = zip(*(self.kept[i] for i in places), strict=True)
        return torch.stack(psfs), torch.stack(lights)


def _line(
    at: Callable[[Tensor], Tensor], span: tuple[float, float], tolerance: float
) -> tuple[int, float]:
    """Number and density of the nodes that a line of PSFs needs; ``at`` gives PSFs at
    places 0 … ALONG.
    """
    known, count = _Known(at), 5
    while count <= MOST:
        tried = [
            (known.error(placed(count, d, span).int().tolist()), d) for d in DENSER
        ]
        error, denser = min(tried)
        if error <= tolerance:
            return count, denser
        most = (
            count - 1
            if error > 0.3
            else (count - 1) * (error / tolerance) ** (1 / ORDER)
        )
        count = max(count + 2, 1 + 2 * math.ceil(0.45 * min(most, 2 * (count - 1))))
    raise SceneError(
        f"{count - 2} field points along an axis leave {error:.2g} of the image, above {tolerance:.2g}: "
        "raise the tolerance or the sample, or narrow the field"
    )


def _fewest(at: Callable[[Tensor], Tensor], tolerance: float, what: str) -> int:
    """Nodes needed at even steps of a line of PSFs; ``at`` gives PSFs at places 0 …
    FINE.
    """
    known = _Known(at)
    for step in STEPS:
        error = known.error(list(range(0, FINE + 1, step)))
        if error <= tolerance:
            return FINE // step + 1
    raise SceneError(
        f"{FINE // step + 1} {what} leave {error:.2g} of the image, above {tolerance:.2g}: "
        "raise the tolerance or the sample, or narrow the field"
    )
