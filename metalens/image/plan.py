"""Which field points, depths and wavelengths an image needs: tried on one line through
the field, cheapest first.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.core.threads import run_split_torch
from metalens.image.model_error import (
    JudgedPsfs,
    choose_polarisation,
    folding_error,
    transform_error,
)
from metalens.image.points import Optics, Window, psfs
from metalens.image.scene import is_plain_value
from metalens.image.splines import TAPS, spline_matrix
from metalens.image.texture import scene_error
from metalens.image.waves import PillarWave
from metalens.psf import Polarisation, Source, SpectralNodes
from metalens.psf import spectrum as spectra

MOST = 57  # nodes along an axis of the field or of 1/z
# Largest errors of interpolation, and of aliased light, whatever the tolerance:
# uniformly illuminated planes then vary by half a percent between the nodes.
NODES_MOST, FOLDED_MOST = 0.005, 0.001
JUDGED = 8  # places of the field at which windows are judged
# of the tolerance: kernels, whose number is what an image costs, and each of six other
# causes; in quadrature all of it
KERNELS, OTHERS = 0.75, 0.27


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

    def crop(self, whole: Tensor) -> Tensor:
        """(…, y, x) image without margin and spare, from one of the whole frame."""
        edge = self.margin + self.spare
        y, x = (slice(edge, edge + n) for n in self.samples)
        return whole[..., y, x]

    @property
    def half_um(self) -> list[float]:
        """[y, x] from the middle of the frame to its last sample: how far the field
        reaches.
        """
        return [(n - 1) / 2 * self.step_um for n in self.frame]


@dataclass(frozen=True, eq=False, slots=True)
class ImagingPlan:
    """Nodes of a field of PSFs.

    y_um, x_um: rows and columns of the nodes on the sensor, from the first to the last
    sample.
    depths_um: ascending, at equal steps of 1/z. waves: wavelengths and weights. window:
    of the PSFs.
    """

    y_um: Tensor
    x_um: Tensor
    depths_um: Tensor
    waves: SpectralNodes
    window: Window

    @property
    def places_um(self) -> Tensor:
        """(nodes, [x, y]) field points of all nodes, row by row."""
        y, x = torch.meshgrid(self.y_um.to(self.x_um), self.x_um, indexing="ij")
        return torch.stack([x.flatten(), y.flatten()], -1)


def plan_nodes(
    optics: Optics,
    grid: Grid,
    source: Source | spectra.MeasuredSpectrum | SpectralNodes,
    middle_um: tuple[float, float],
    *,
    tolerance: float,
    polarisation: Polarisation = "auto",
) -> ImagingPlan:
    """The fewest nodes that interpolate the PSFs within their shares of the tolerance.

    Field nodes are tried on a line at 0.6 of the half height, depth nodes at two field
    points. PSFs half-way between the nodes judge each number. These trials use two
    wavelengths of the spectrum. The window's period and curvature follow from the light
    that the transform aliases and neglects (:mod:`metalens.image.model_error`), its
    components from :func:`metalens.image.model_error.choose_polarisation`.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        grid: samples, step, depths and margin of the image.
        source: spectrum of the source.
        middle_um: (x, y) field point in the middle, um on the sensor.
        tolerance: relative L2 error of the image; each cause takes its share.
        polarisation: see :func:`metalens.image.imager`.

    Raises:
        SceneError: tolerance not above 0, or not met with ``MOST`` nodes along an axis.
    """
    if not 0 < tolerance < 1:
        raise SceneError(f"tolerance {tolerance}: need 0 < tolerance < 1")
    half = grid.half_um
    share = tolerance * OTHERS
    waves = waves_of(optics, grid, source, middle_um, half, share)
    coarse = waves if isinstance(source, SpectralNodes) else _coarse(optics, source, 2)
    three_depths = depth_nodes(grid, 3)
    window = _suppress_aliasing(
        optics,
        coarse,
        Window(grid.window, grid.step_um),
        (_places(spread_places(JUDGED), middle_um, half), three_depths),
        min(share, FOLDED_MOST),
    )

    def along_field(unit: Tensor) -> Tensor:
        x = (2 * unit - 1) * half[1]
        at = torch.stack([x, torch.full_like(x, 0.6 * half[0])], -1)
        at = at + torch.tensor(middle_um, dtype=torch.float64)
        return sum_over_spectrum(optics, at, three_depths, coarse, window)

    def along_depth(unit: Tensor) -> Tensor:
        at = _places(((0.0, 0.0), (0.7, -0.4)), middle_um, half)
        nearest, farthest = (1 / d for d in grid.depths_um)
        depths = 1 / (nearest + (farthest - nearest) * unit)
        return sum_over_spectrum(optics, at, depths, coarse, window).transpose(0, 1)

    node_tolerance = min(share, NODES_MOST)
    columns = _node_count(along_field, node_tolerance, "field")
    depths = 1
    if grid.depths_um[0] != grid.depths_um[1]:
        depths = _node_count(along_depth, node_tolerance, "range of depths")
    two_places = spread_places(JUDGED)[1::4]
    off_axis = _places(two_places, middle_um, half), three_depths
    if transform_error(JudgedPsfs(optics, coarse, window, off_axis)) > share:
        window = replace(window, curved=True)
    with_middle = _places([*two_places, (0.0, 0.0)], middle_um, half), three_depths
    judged = JudgedPsfs(optics, coarse, window, with_middle)
    window = choose_polarisation(judged, polarisation, within=(tolerance, share))
    y, x = (
        centre
        + length
        * torch.linspace(-1, 1, _along(columns, length / half[1]), dtype=torch.float64)
        for centre, length in zip(middle_um[::-1], half, strict=True)
    )
    return ImagingPlan(y, x, depth_nodes(grid, depths), waves, window)


def spread_places(count: int) -> list[tuple[float, float]]:
    """(x, y) places in half fields, out to 0.95 of it: equal steps of x, and y in steps
    of the golden section.

    Near the rims a blur is widest and most light is aliased.

    Args:
        count: of the places.
    """
    golden = (math.sqrt(5) - 1) / 2
    return [
        (0.95 * (2 * k / (count - 1) - 1), 0.95 * (2 * (golden * (k + 1) % 1) - 1))
        for k in range(count)
    ]


def depth_nodes(grid: Grid, count: int) -> Tensor:
    """(count,) depths ascending, at equal steps of 1/z.

    Args:
        grid: samples, step, depths and margin of the image.
    """
    near, far = grid.depths_um
    return 1 / torch.linspace(1 / near, 1 / far, count, dtype=torch.float64)


def sum_over_spectrum(
    optics: Optics,
    at_um: Tensor,
    depths_um: Tensor,
    waves: SpectralNodes,
    window: Window,
) -> Tensor:
    """(points, depths, h, w) PSFs summed over the spectrum, Σ weight · PSF(λ).

    Field points run in parallel on the processor where no gradient is needed.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        at_um: (points, [x, y]) field points on the sensor, um.
        depths_um: (depths,) source depths from the lens, um.
        waves: wavelengths in um with their weights.
        window: samples of a PSF.
    """
    wavelengths = waves.wavelengths_um.tolist()
    pairs = list(zip(wavelengths, waves.weights.tolist(), strict=True))
    shared = {"depths_um": depths_um, "window": window, "finest_um": min(wavelengths)}

    # all wavelengths of a point share its rays
    def at_place(place: Tensor) -> Tensor:
        total = torch.zeros(())
        for wave, weight in pairs:
            total = total + weight * psfs(optics, place, wavelength_um=wave, **shared)
        return total

    first, *others = at_um.unsqueeze(1)
    images = [at_place(first)] + [torch.empty(0)] * len(others)

    def fill(start: int, stop: int) -> None:
        for i in range(start, stop):
            images[i + 1] = at_place(others[i])

    if is_plain_value(images[0]):
        run_split_torch(len(others), torch.no_grad()(fill))
    else:  # derivatives, or another device
        fill(0, len(others))
    return torch.cat(images)


def _suppress_aliasing(
    optics: Optics,
    waves: SpectralNodes,
    window: Window,
    at: tuple[Tensor, Tensor],
    tolerance: float,
) -> Window:
    """The window with the shortest period whose aliased light is within the tolerance.

    The period grows by 2^(1/4) at a time, to four widths of the window at most.

    Args:
        at: field points (n, [x, y]) in um and depths in um, at which it is judged.
    """
    while folding_error(JudgedPsfs(optics, waves, window, at)) > tolerance:
        if window.period >= 4:
            break
        window = replace(window, period=2**0.25 * window.period)
    return window


def _places(
    units: Sequence[tuple[float, float]],
    middle_um: tuple[float, float],
    half_um: list[float],
) -> Tensor:
    """(places, [x, y]) field points, um on the sensor.

    Args:
        units: (x, y) in half widths of the field.
        middle_um: (x, y) of its middle.
        half_um: [y, x] half widths.
    """
    middle, half = (
        torch.tensor(pair, dtype=torch.float64) for pair in (middle_um, half_um[::-1])
    )
    return middle + half * torch.tensor(units, dtype=torch.float64)


def waves_of(
    optics: Optics,
    grid: Grid,
    source: Source | spectra.MeasuredSpectrum | SpectralNodes,
    middle_um: tuple[float, float],
    half_um: list[float],
    tolerance: float,
) -> SpectralNodes:
    """The fewest Gauss wavelengths that image within the tolerance at three places.

    Rules of 1, 2, … 16 wavelengths are compared, each with the last. Wavelengths that
    come with weights are returned as they are.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        grid: samples, step, depths and margin of the image.
        source: spectrum of the source.
        middle_um: (x, y) field point in the middle, um on the sensor.
        half_um: [y, x] half widths of the field.
        tolerance: relative L2 error of the image.
    """
    if isinstance(source, SpectralNodes):
        return source
    at = _places(((0.0, 0.0), (0.5, 0.3), (0.9, 0.8)), middle_um, half_um)
    depths = depth_nodes(grid, 2)
    window = Window(grid.window, grid.step_um)
    last = sum_over_spectrum(optics, at, depths, _coarse(optics, source, 1), window)
    outside = source.outside if isinstance(source, spectra.MeasuredSpectrum) else 0.0
    for count in range(2, 17):
        rule = _coarse(optics, source, count)
        images = sum_over_spectrum(optics, at, depths, rule, window)
        error = scene_error(last, images)
        if error + outside <= tolerance:  # the change to this rule, which errs by less
            return replace(rule, error=error + outside)
        last = images
    raise SceneError(
        f"16 wavelengths leave {error:.2g} of the image, above {tolerance:.2g}: raise the tolerance"
    )


def _coarse(
    optics: Optics, source: Source | spectra.MeasuredSpectrum, count: int
) -> SpectralNodes:
    """Gauss rule of ``count`` wavelengths, within those of the pillars' library."""
    rule = SpectralNodes(
        *spectra.discrete_gauss_rule(*spectra.spectrum_points(source), count), np.nan
    )
    if not isinstance(optics.wave, PillarWave):
        return rule
    return spectra.nodes_inside_library(
        rule, source, optics.wave.lens.proxy.wavelengths_um
    )


def _along(count: int, length: float) -> int:
    """Nodes of an axis ``length`` times as long as an axis of ``count`` nodes."""
    return max(TAPS, math.ceil((count - 1) * length) + 1)


DARK = (
    "a PSF has no light within its window at some place, depth or wavelength of the scene: a frame that reaches to "
    "80 degrees of field or beyond (take fewer or smaller samples), or a margin narrower than the blur"
)


def _node_count(
    psfs_at: Callable[[Tensor], Tensor], tolerance: float, cure: str
) -> int:
    """Number of nodes at equal steps from which splines interpolate a line of PSFs.

    The image of a textured scene, by PSFs half-way between the nodes, is within the
    tolerance. Up to ``MOST`` nodes are tried.

    Args:
        psfs_at: function from places 0 … 1 of the line to PSFs (places, depths, h, w).
        cure: words for what to narrow, in the error's text.
    """
    count = 5
    while count <= MOST:
        places = torch.linspace(0, 1, 2 * count - 1, dtype=torch.float64)
        light = psfs_at(places)
        if not bool((light.sum((-1, -2)) > 0).all()):
            raise SceneError(DARK)
        matrix = spline_matrix(places[1::2], count).to(light)
        interpolated = torch.tensordot(matrix, light[::2], 1)
        error = scene_error(interpolated, light[1::2])
        if error <= tolerance:
            return count
        # errors fall as the distance of nodes to the power of 2.5 and more
        estimate = min((error / tolerance) ** 0.4, 2.0) * (count - 1)
        count = max(count + 2, 1 + 2 * math.ceil(0.45 * estimate))
    raise SceneError(
        f"{count - 2} nodes leave {error:.2g} of the image, above {tolerance:.2g}: "
        f"raise the tolerance or the sample, or narrow the {cure}"
    )
