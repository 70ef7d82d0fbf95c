"""What a lens does to light, as the pupil of a field point sees it: a known carrier and
a slowly varying factor.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.design import Focus
from metalens.image.scene import is_plain_value
from metalens.lens import Lens, response
from metalens.optics import Layers, interpolant
from metalens.psf import neighbour_coupling

# largest width over which pillars are averaged: below a zone of the lens, many pitches
CELL_UM = 2.5


class Wave(Protocol):
    """A lens plane: radius of the open aperture, carrier and factor."""

    @property
    def radius_um(self) -> float:
        """Of the open aperture."""

    def carrier_rad(self, x_um: Tensor, y_um: Tensor) -> Tensor:
        """Phase of the design, rad, float64, without a gradient."""

    def factor(
        self, x_um: Tensor, y_um: Tensor, wavelength_um: float, angle_rad: float
    ) -> Tensor | None:
        """Complex transmission less the carrier, differentiable; None where it is 1."""


@dataclass(frozen=True, eq=False, slots=True)
class SmoothWave:
    """A hyperbolic focus and an added phase, the same at all wavelengths and angles.

    added_rad: (x_um, y_um) to the added phase in rad, float64, differentiable; None for
    none.
    """

    focus: Focus
    radius_um: float
    added_rad: Callable[[Tensor, Tensor], Tensor] | None = None

    def carrier_rad(self, x_um: Tensor, y_um: Tensor) -> Tensor:
        """The hyperbolic phase of the focus."""
        return focusing_phase(self.focus, x_um, y_um)

    def factor(
        self, x_um: Tensor, y_um: Tensor, wavelength_um: float, angle_rad: float
    ) -> Tensor | None:
        """exp(i added)."""
        if self.added_rad is None:
            return None
        phase = self.added_rad(x_um, y_um)
        turns = torch.round(phase.detach() / (2 * math.pi))
        angle = (phase - 2 * math.pi * turns).to(torch.float32)
        return torch.polar(torch.ones_like(angle), angle)


class PillarWave:
    """The pillars of a lens through its proxy: mean of t exp(-i carrier) over cells of
    a few micrometres.

    diameter_um: in place of those of the lens, (y, x), a tensor that the PSFs are
    differentiable in. cell_um: width of
    the cells, a whole number of pitches, one at least.

    Different neighbours count where the lens holds their rows (:mod:`metalens.psf.neighbour_coupling`,
    the mean of both polarisations).
    Light that single pillars scatter out of their cell's mean is lost to the image;
    what of it lands in the window is
    measured by :mod:`metalens.image.model_error`.

    Raises:
        SceneError: another lattice than a square one, turned pillars, those of two
            sizes, or such that transmit x and y
            differently.
    """

    def __init__(
        self, lens: Lens, *, diameter_um: Tensor | None = None, cell_um: float = CELL_UM
    ) -> None:
        if lens.pairs is not None:
            raise SceneError(
                "pillars of two sizes differ along x and y: the image of the whole field is of unpolarised light and "
                "of pillars of one size; metalens psf LENS --light x (or y, or both) gives PSFs of single directions"
            )
        if not lens.diameters.plain:
            raise SceneError(
                f"pillars on a {lens.diameters.lattice.kind} lattice{', turned one by one' if lens.hand else ''}: the "
                "image of the whole field knows square lattices of pillars that are not turned; metalens psf gives "
                "PSFs of single directions"
            )
        if lens.one_light:
            raise SceneError(
                f"pillars ({lens.cell.described}) that differ along x and y, of which the lens knows {lens.one_light} "
                "alone: the image is of unpolarised light (metalens psf says of which light it is)"
            )
        self.lens = lens
        self.focus = Focus(
            lens.wavelength_um,
            lens.sensor_distance_um,
            lens.source_distance_um,
            lens.layers,
        )
        d = lens.diameters
        self.radius_um = d.radius_um + d.pitch_um / 2
        self.diameter_um = (
            torch.as_tensor(np.ascontiguousarray(d.diameter_um))
            if diameter_um is None
            else diameter_um
        )
        self._block = max(1, round(cell_um / d.pitch_um))
        self._cells: dict[tuple[float, float], Tensor] = {}

    def carrier_rad(self, x_um: Tensor, y_um: Tensor) -> Tensor:
        """The hyperbolic phase that the design aims at."""
        return focusing_phase(self.focus, x_um, y_um)

    def factor(
        self, x_um: Tensor, y_um: Tensor, wavelength_um: float, angle_rad: float
    ) -> Tensor | None:
        """Mean transmission of cells, less the carrier, interpolated to places (x, y).

        Interpolation is bilinear. Cells are cached for the last 16 wavelengths and
        angles. With a gradient, backward smooths over the width of a node, as nodes
        read only some of the cells.

        Args:
            x_um: places on the lens, um.
            y_um: places on the lens, um.
            wavelength_um: vacuum wavelength, um.
            angle_rad: of incidence, used where the library has angles.
        """
        tilt = angle_rad if self.lens.proxy.max_angle_rad > 0 else 0.0
        key = (wavelength_um, tilt)
        cells = self._cells.get(key)
        if cells is None:
            cells = self._gathered(wavelength_um, tilt).to(x_um.device)
            if not cells.requires_grad:
                self._cells = {**dict(list(self._cells.items())[-15:]), key: cells}
        pitch = self.lens.diameters.pitch_um
        cell_width = self._block * pitch
        if cells.requires_grad:  # values of the cells, gradients of their means
            node_width = float(x_um.max() - x_um.min()) / (x_um.shape[-1] - 1)
            smooth = _averaged(cells, node_width / cell_width)
            cells = smooth + (cells - smooth).detach()
        half = [n * self._block * pitch / 2 for n in cells.shape[-2:]]
        # where an odd number of rows or columns is added, the cells' centre lies half a
        # pitch beyond that of the lens
        shift = [
            (n - own) % 2 * pitch / 2
            for n, own in zip(self._padded, self.diameter_um.shape, strict=True)
        ]
        centre = (shift[1], shift[0])
        return interpolate_cells(cells, (x_um, y_um), centre, (half[1], half[0]))

    @property
    def pitch_um(self) -> float:
        """Of the pillars."""
        return self.lens.diameters.pitch_um

    @property
    def _padded(self) -> tuple[int, int]:
        """(y, x) pillars with the empty rows and columns that fill the last cells."""
        y, x = (n + (-n) % self._block for n in self.diameter_um.shape)
        return y, x

    def pillar_transmission(self, wavelength_um: float, angle_rad: float) -> Tensor:
        """(y, x) complex transmission of every site, with the factor of its neighbours.

        It is 0 at sites without a pillar.

        Args:
            wavelength_um: vacuum wavelength, um.
            angle_rad: of incidence, used where the library has angles.
        """
        tilt = angle_rad if self.lens.proxy.max_angle_rad > 0 else 0.0
        return self._with_neighbours(self._pillars(wavelength_um, tilt)[0])

    def _with_neighbours(self, t: Tensor) -> Tensor:
        """Transmission t times the mean coupling of neighbours, if there is any."""
        if self.lens.neighbours is None:
            return t
        return t * neighbour_coupling.mean_coupling(
            t, self.lens.neighbours, self.lens.diameters.pitch_um
        )

    def orders(self, wavelength_um: float, orders: tuple[int, ...]) -> dict[int, float]:
        """Share of the light on the aperture in each diffraction order m of the zones.

        |Σ t exp(-i m φ) / N|², with φ the design's carrier; order 1 focuses.

        Args:
            wavelength_um: vacuum wavelength, um.
            orders: numbers m.
        """
        t, ideal, open_ = self._pillars(wavelength_um, 0.0)
        return {
            m: float((t * torch.polar(open_, -m * ideal)).sum().abs() / open_.sum())
            ** 2
            for m in orders
        }

    @functools.cached_property
    def _ideal(self) -> Tensor:
        """(y, x) carrier of every pillar, whole turns off, in single precision."""
        d, device = self.lens.diameters, self.diameter_um.device
        x, y = (torch.as_tensor(a, device=device) for a in (d.x_um, d.y_um))
        return torch.remainder(self.carrier_rad(x, y[:, None]), 2 * math.pi).to(
            torch.float32
        )

    def _pillars(
        self, wavelength_um: float, tilt: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(y, x) complex t, carrier in rad, and 1 where a pillar stands, float32.

        The first is differentiable where the diameters are.
        """
        d, proxy = self.diameter_um, self.lens.proxy
        open_ = (d > 0).to(torch.float32)
        if is_plain_value(d):
            phases, levels = torch.empty(2, *d.shape)
            response.fill_response_of(
                proxy,
                d.detach().numpy(),
                (wavelength_um, tilt),
                phases.numpy(),
                levels.numpy(),
            )
            return torch.polar(levels, phases), self._ideal, open_
        inside = torch.where(d > 0, d, torch.full_like(d, proxy.domain_um[0]))
        phase: Any = proxy.phase_rad(inside, wavelength_um, tilt)
        level: Any = proxy.transmission(inside, wavelength_um, tilt)
        return (
            torch.polar(level.to(torch.float32) * open_, phase.to(torch.float32)),
            self._ideal,
            open_,
        )

    def _gathered(self, wavelength_um: float, tilt: float) -> Tensor:
        """(2, cells y, cells x) real and imaginary mean of t exp(-i carrier) per cell.

        An empty cell has the mean of the 3 x 3 cells around it.
        """
        t, ideal, open_ = self._pillars(wavelength_um, tilt)
        residual = torch.view_as_real(
            self._with_neighbours(t) * torch.polar(torch.ones_like(ideal), -ideal)
        ).permute(2, 0, 1)
        pad = []
        for padded, n in zip(self._padded[::-1], ideal.shape[::-1], strict=True):
            pad += [(padded - n) // 2, (padded - n + 1) // 2]
        mean = torch.nn.functional.avg_pool2d(
            torch.nn.functional.pad(torch.cat([residual, open_[None]]), pad)[None],
            self._block,
        )[0]
        near = torch.nn.functional.avg_pool2d(mean[None], 3, stride=1, padding=1)[0]
        filled = torch.where(mean[2] > 0, mean[:2], near[:2])
        return filled / torch.where(mean[2] > 0, mean[2], near[2]).clamp_min(1e-12)


def interpolate_cells(
    cells: Tensor,
    at_um: tuple[Tensor, Tensor],
    centre_um: tuple[float, float],
    half_um: tuple[float, float],
) -> Tensor:
    """Complex means of cells at places, bilinear and constant beyond the outer cells.

    Args:
        cells: (2, y, x) real and imaginary parts.
        at_um: x and y of the places, of one shape.
        centre_um: (x, y) middle of the cells.
        half_um: (x, y) half of their extent.
    """
    place = [(a - c) / h for a, c, h in zip(at_um, centre_um, half_um, strict=True)]
    factor = torch.nn.functional.grid_sample(
        cells[None],
        torch.stack(place, -1).to(cells).reshape(1, 1, -1, 2),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    return torch.complex(*factor.reshape(2, *at_um[0].shape).unbind(0))


def _averaged(cells: Tensor, width: float) -> Tensor:
    """(2, y, x) cells averaged over the width of a node, those that contain pillars.

    Args:
        cells: (2, y, x) real and imaginary means.
        width: of a node, in cells; less than 2 leaves the cells as they are.
    """
    reach = round((width - 1) / 2)
    if reach < 1:
        return cells
    filled = (cells.detach() != 0).any(0, keepdim=True).to(cells)
    size, edge = 2 * reach + 1, reach
    both = torch.nn.functional.avg_pool2d(
        torch.cat([cells, filled])[None], size, stride=1, padding=edge
    )[0]
    mean: Tensor = both[:2] / both[2].clamp_min(0.2)
    return mean


def focusing_phase(focus: Focus, x_um: Tensor, y_um: Tensor) -> Tensor:
    """-k (√(r²+d²) - d + √(r²+s²) - s): source distance s imaged onto sensor distance d
    (paper Eq. 1, exp(-iωt)).

    Through the films of the focus the paths are those of
    :meth:`metalens.design.Focus.path_um`.

    Args:
        x_um: places along x, um.
        y_um: places along y, um.
    """
    r2 = (x_um * x_um + y_um * y_um).cpu().numpy()
    path = interpolant.chebyshev_interpolant(focus.path_um, r2)
    return torch.from_numpy(-2 * math.pi / focus.wavelength_um * path).to(x_um.device)


def cell_um(
    layers: Layers, wavelength_um: float, window_um: float, distance_um: float
) -> float:
    """Largest width of cells, um, that keeps the light scattered into a window.

    A third of a node's width λ d / window on the lens, and ``CELL_UM`` at most.

    Args:
        layers: films and stop of the lens.
        wavelength_um: vacuum wavelength, um.
        window_um: side of the window, um.
        distance_um: from lens to window, um.
    """
    node_um = (
        wavelength_um * layers.after(distance_um, wavelength_um).reduced_um / window_um
    )
    # mean and interpolation leave light at a window's rim sinc³(1/6) = 0.87 of its
    # amplitude
    return min(CELL_UM, node_um / 3)


def wave_of(
    lens: Lens | Wave,
    layers: Layers,
    window_um: float,
    distance_um: float | None = None,
) -> Wave:
    """The lens plane of a lens file, in cells of :func:`cell_um`; a wave unchanged.

    Args:
        lens: content of a lens file, or a wave.
        layers: films and stop of the lens.
        window_um: side of the PSFs' window, um.
        distance_um: from lens to sensor; None for the design's.
    """
    if isinstance(lens, Lens):
        distance = lens.sensor_distance_um if distance_um is None else distance_um
        return PillarWave(
            lens, cell_um=cell_um(layers, lens.wavelength_um, window_um, distance)
        )
    if not hasattr(lens, "carrier_rad"):
        raise SceneError(
            f"{type(lens).__name__} is no lens: need a Lens, a SmoothWave or a PillarWave"
        )
    return lens
