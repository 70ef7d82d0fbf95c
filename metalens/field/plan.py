"""Which field points, depths and wavelengths an image needs: tried on one line through the field, cheapest first."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from metalens.field.patches import dense, relative
from metalens.field.points import Optics, Window, psfs
from metalens.ground.errors import SceneError
from metalens.psf import Nodes, Source
from metalens.psf import spectrum as spectra

STEPS = (24, 16, 12, 8, 6, 4)  # between nodes that are tried, in 96ths of the field or of the range of 1/z
FINE = 96
SHARES = {"kernels": 0.6, "field": 0.5, "depth": 0.3, "spectrum": 0.4}  # of the tolerance; together 0.93 of it


@dataclass(frozen=True, slots=True)
class Grid:
    """Where a scene is sampled: as :class:`metalens.image.Frames` has it, upright on the sensor.

    samples: (y, x) of the image that is returned. step_um: of the samples on the sensor.
    margin: samples around them that are rendered too, blurred in, and not returned.
    depths_um: (least, largest) that the scene holds. window: samples of a PSF along an axis, odd.

    A sample at (x, y) um from the axis shows the direction whose tangents are (x, y) / reduced distance, the sum of
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
        if not 0 < near <= far < math.inf:
            raise SceneError(f"depths {self.depths_um} um: need 0 < least <= largest, finite")

    @property
    def spare(self) -> int:
        """Samples that are continued beyond the rendered ones, so that no PSF ends at the border."""
        return max(self.window // 2 - self.margin, 0)

    @property
    def frame(self) -> tuple[int, int]:
        """(y, x) samples on which sources may lie: image, margin and spare."""
        return self.samples[0] + 2 * (self.margin + self.spare), self.samples[1] + 2 * (self.margin + self.spare)


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Nodes of a field of PSFs.

    y_um, x_um: rows and columns of the nodes on the sensor, from the first to the last sample.
    depths_um: ascending, at equal steps of 1/z. waves: wavelengths and weights. window: of the PSFs.
    folds: whether the lens is round and the grid on its axis, so that one eighth of the nodes gives all.
    """

    y_um: Tensor
    x_um: Tensor
    depths_um: Tensor
    waves: Nodes
    window: Window
    folds: bool


def planned(
    optics: Optics, grid: Grid, source: Source | Nodes, middle_um: tuple[float, float], *, tolerance: float, folds: bool
) -> Plan:
    """The fewest nodes that interpolate the PSFs within their shares of the tolerance.

    Tried on a line across the field (at 0.6 of its half height), whose points in between judge every candidate, for
    the nearest, the middle and the farthest depth. A whole spectrum is used from the start, coarse for the line.

    Raises:
        SceneError: tolerance not above 0, or not met with 25 nodes along an axis.
    """
    if not 0 < tolerance < 1:
        raise SceneError(f"tolerance {tolerance}: need 0 < tolerance < 1")
    window = Window(grid.window, grid.step_um)
    half = [(n - 1) / 2 * grid.step_um for n in grid.frame]
    waves = waves_of(optics, grid, source, middle_um, half, tolerance * SHARES["spectrum"])
    coarse = _coarse(source, 2) if isinstance(source, Source) else waves
    ends = depth_nodes(grid, 3)

    def across(places: Tensor) -> Tensor:
        x = torch.stack([(2 * places / FINE - 1) * half[1], torch.full_like(places, 0.6 * half[0])], -1)
        return spectral(optics, x + torch.tensor(middle_um, dtype=torch.float64), ends, coarse, window)

    def deep(places: Tensor) -> Tensor:
        at = torch.tensor([[0.0, 0.0], [0.7 * half[1], -0.4 * half[0]]], dtype=torch.float64)
        at = at + torch.tensor(middle_um, dtype=torch.float64)
        near, far = (1 / d for d in grid.depths_um)
        return spectral(optics, at, 1 / (near + (far - near) * places / FINE), coarse, window).transpose(0, 1)

    count = _fewest(across, tolerance * SHARES["field"], "field points along an axis")
    depths = 1 if grid.depths_um[0] == grid.depths_um[1] else _fewest(deep, tolerance * SHARES["depth"], "depths")
    long = max(half)
    counts = [max(2, math.ceil((count - 1) * h / long) + 1) for h in half]
    y, x = (
        m + torch.linspace(-h, h, c, dtype=torch.float64) for m, h, c in zip(middle_um[::-1], half, counts, strict=True)
    )
    return Plan(y, x, depth_nodes(grid, depths), waves, window, folds and counts[0] == counts[1] and half[0] == half[1])


def depth_nodes(grid: Grid, count: int) -> Tensor:
    """(count,) depths ascending, at equal steps of 1/z."""
    near, far = grid.depths_um
    return 1 / torch.linspace(1 / near, 1 / far, count, dtype=torch.float64)


def spectral(optics: Optics, at_um: Tensor, depths_um: Tensor, waves: Nodes, window: Window) -> Tensor:
    """(points, depths, h, w) PSFs summed over the spectrum; light of each wavelength with its weight."""
    total = torch.zeros(())
    for wave, weight in zip(waves.wavelengths_um.tolist(), waves.weights.tolist(), strict=True):
        total = total + weight * psfs(optics, at_um, depths_um=depths_um, wavelength_um=wave, window=window)
    return total


def waves_of(
    optics: Optics,
    grid: Grid,
    source: Source | Nodes,
    middle_um: tuple[float, float],
    half_um: list[float],
    tolerance: float,
) -> Nodes:
    """As few wavelengths of a source as image within the tolerance at three places; a given rule is kept as it is."""
    if isinstance(source, Nodes):
        return source
    at = torch.tensor([[0.0, 0.0], [0.5, 0.3], [0.9, 0.8]], dtype=torch.float64)
    at = at * torch.tensor([half_um[1], half_um[0]], dtype=torch.float64) + torch.tensor(middle_um, dtype=torch.float64)
    ends, window = depth_nodes(grid, 2), Window(grid.window, grid.step_um)
    last = spectral(optics, at, ends, _coarse(source, 1), window)
    for count in range(2, 17):
        made = _coarse(source, count)
        found = spectral(optics, at, ends, made, window)
        error = float(relative(last, found).max())
        if error <= tolerance:  # of the rule before; this one is finer
            return replace(_coarse(source, count - 1), error=error)
        last = found
    raise SceneError(f"16 wavelengths leave {error:.2g} of the image, above {tolerance:.2g}: raise the tolerance")


def _coarse(source: Source, count: int) -> Nodes:
    um, share = spectra.weight(source)
    return Nodes(*spectra.gauss(um, share, count), np.nan)


def _fewest(at: Callable[[Tensor], Tensor], tolerance: float, what: str) -> int:
    """Nodes needed on a line of PSFs, judged half-way between them; ``at`` gives PSFs at places 0 … FINE."""
    known: dict[int, Tensor] = {}

    def line(places: range) -> Tensor:
        missing = [i for i in places if i not in known]
        if missing:
            found = at(torch.tensor(missing, dtype=torch.float64))
            known.update(zip(missing, found / found.sum((-1, -2), keepdim=True), strict=True))
        return torch.stack([known[i] for i in places])

    for step in STEPS:
        nodes, between = range(0, FINE + 1, step), range(step // 2, FINE, step)
        weights = dense(torch.tensor(between, dtype=torch.float64) / step, len(nodes))
        want = line(between)
        got = torch.einsum("nk,kzyx->nzyx", weights.to(want), line(nodes))
        error = float((relative(got, want) ** 2).mean(0).sqrt().max())
        if error <= tolerance:
            return len(nodes)
    raise SceneError(
        f"{len(nodes)} {what} leave {error:.2g} of the image, above {tolerance:.2g}: "
        "raise the tolerance or the sample, or narrow the field"
    )
