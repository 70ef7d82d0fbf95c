"""What a lens does to light, as the pupil of a field point sees it: a known carrier and
a slowly varying factor.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.design import Focus
from metalens.image import compiled
from metalens.image.compiled import is_plain_value
from metalens.lens import Lens, response
from metalens.optics import Layers, Media, interpolant, media
from metalens.psf import among

# over which pillars are averaged at most: below a zone of the lens, far above the pitch
CELL_UM = 2.5


class Wave(Protocol):
    """A lens plane: radius of the open aperture, carrier and factor."""

    @property
    def radius_um(self) -> float:
        """Of the open aperture."""

    def carrier_rad(self, x_um: Tensor, y_um: Tensor) -> Tensor:
        """Phase in float64 that is known beforehand and carries no gradient."""

    def factor(
        self, x_um: Tensor, y_um: Tensor, wavelength_um: float, angle_rad: float
    ) -> Tensor | None:
        """Complex transmission less the carrier, differentiable; None where it is 1."""


@runtime_checkable
class PillarPlane(Protocol):
    """A lens plane whose factor is a mean over pillars of known transmission."""

    @property
    def pitch_um(self) -> float:
        """Of the square lattice."""

    def pillar_transmission(self, wavelength_um: float, angle_rad: float) -> Tensor:
        """(y, x) complex t of every pillar, 0 where there is none."""


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

    Unlike neighbours count where the lens holds their rows (:mod:`metalens.psf.among`,
    the mean of both polarisations).
    Light that single pillars scatter out of their cell's mean is lost to the image;
    what of it lands in the window is
    measured by :mod:`metalens.image.left_out`.

    Raises:
        SceneError: another lattice than a square one, turned pillars, those of two
            sizes, or such that answer x and y
            apart.
    """

    def __init__(
        self, lens: Lens, *, diameter_um: Tensor | None = None, cell_um: float = CELL_UM
    ) -> None:
        if lens.pairs is not None:
            raise SceneError(
                "pillars of two sizes answer x and y apart: the image of the whole field is of unpolarised light and "
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
                f"pillars ({lens.cell.described}) that answer x and y apart, of which the lens knows {lens.one_light} "
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
        """Cells interpolated to the rays; the pillars answer at the angle of the light
        where the library has angles.
        """
        tilt = angle_rad if self.lens.proxy.max_angle_rad > 0 else 0.0
        key = (wavelength_um, tilt)
        cells = self._cells.get(key)
        if cells is None:
            cells = self._gathered(wavelength_um, tilt).to(x_um.device)
            if not cells.requires_grad:
                self._cells = {**dict(list(self._cells.items())[-15:]), key: cells}
        pitch = self.lens.diameters.pitch_um
        # nodes read some of the cells; how the light changes, their means over a node
        # tell
        if cells.requires_grad:
            near = _over(
                cells,
                float(x_um.max() - x_um.min())
                / (x_um.shape[-1] - 1)
                / (self._block * pitch),
            )
            cells = near + (cells - near).detach()
        half = [n * self._block * pitch / 2 for n in cells.shape[-2:]]
        # the cells are half a pitch past the lens's middle where one row or column more
        # is added behind it
        past = [
            (n - own) % 2 * pitch / 2
            for n, own in zip(self._padded, self.diameter_um.shape, strict=True)
        ]
        place = torch.stack(
            [(x_um - past[1]) / half[1], (y_um - past[0]) / half[0]], -1
        ).to(cells)
        found = torch.nn.functional.grid_sample(
            cells[None],
            place.reshape(1, 1, -1, 2),
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
        )
        return torch.complex(*found.reshape(2, *x_um.shape).unbind(0))

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
        """(y, x) complex transmission of every pillar, 0 where there is none, with the
        factor of its neighbours.

        Args:
            wavelength_um: vacuum wavelength, um. angle_rad: of incidence, used where
                the library has angles.
        """
        return self._with_neighbours(
            self._pillars(
                wavelength_um, angle_rad if self.lens.proxy.max_angle_rad > 0 else 0.0
            )[0]
        )

    def _with_neighbours(self, t: Tensor) -> Tensor:
        """With the factor of unlike neighbours where the lens holds their rows."""
        if self.lens.neighbours is None:
            return t
        return t * among.mean_coupling(
            t, self.lens.neighbours, self.lens.diameters.pitch_um
        )

    def orders(self, wavelength_um: float, orders: tuple[int, ...]) -> dict[int, float]:
        """Share of the light on the aperture that leaves in each diffraction order of
        the zones: 1 focuses.
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
        """(complex t, carrier, 1 where a pillar stands) of every pillar, in single
        precision.
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
        """(2, cells y, cells x) real and imaginary part of the mean of each cell; empty
        cells as their neighbours.
        """
        d = self.diameter_um
        spare = [padded - n for padded, n in zip(self._padded, d.shape, strict=True)]
        if self.lens.neighbours is None and is_plain_value(d):
            sizes, at = d.detach().numpy(), (wavelength_um, tilt)
            block = self._block, spare[0] // 2, spare[1] // 2
            known = response.response_polynomials(self.lens.proxy, sizes, at)
            mean = torch.from_numpy(
                compiled.cells(sizes, self._ideal.numpy(), known, block)
            )
        else:
            mean = self._means(wavelength_um, tilt, spare)
        near = torch.nn.functional.avg_pool2d(mean[None], 3, stride=1, padding=1)[0]
        filled = torch.where(mean[2] > 0, mean[:2], near[:2])
        return filled / torch.where(mean[2] > 0, mean[2], near[2]).clamp_min(1e-12)

    def _means(self, wavelength_um: float, tilt: float, spare: list[int]) -> Tensor:
        """As :func:`metalens.image.compiled.cells`, with derivatives and the factor of
        neighbours.
        """
        t, ideal, open_ = self._pillars(wavelength_um, tilt)
        rest = torch.view_as_real(
            self._with_neighbours(t) * torch.polar(torch.ones_like(ideal), -ideal)
        ).permute(2, 0, 1)
        layers = torch.cat([rest, open_[None]])
        pad = (
            spare[1] // 2,
            spare[1] - spare[1] // 2,
            spare[0] // 2,
            spare[0] - spare[0] // 2,
        )
        return torch.nn.functional.avg_pool2d(
            torch.nn.functional.pad(layers, pad)[None], self._block
        )[0]


def _over(cells: Tensor, width: float) -> Tensor:
    """(2, y, x) mean about each of the cells that hold pillars, of waves longer than
    twice so many cells (Lanczos).
    """
    if width <= 1:
        return cells
    lobes = 2.0  # in widths of a node
    reach = math.ceil(lobes * width) - 1
    away = (
        torch.arange(-reach, reach + 1, device=cells.device, dtype=torch.float64)
        / width
    )
    row = (torch.sinc(away) * torch.sinc(away / lobes) / width).to(cells)
    there = (cells.detach() != 0).any(0, keepdim=True).to(cells)
    both = torch.cat([cells, there])[:, None]
    for shape, pad in (((1, 1, -1, 1), (reach, 0)), ((1, 1, 1, -1), (0, reach))):
        both = torch.nn.functional.conv2d(both, row.reshape(shape), padding=pad)
    mean: Tensor = both[:2, 0] / both[2, 0].clamp_min(0.2)
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
    r2 = x_um * x_um + y_um * y_um
    d = focus.sensor_distance_um
    s = focus.source_distance_um
    films = focus.layers
    total = _longer(films.after(d, focus.wavelength_um), r2)
    if math.isfinite(s):
        total = total + _longer(films.before(s, focus.wavelength_um), r2)
    return -2 * math.pi / focus.wavelength_um * total


def _longer(between: Media, r2: Tensor) -> Tensor:
    """Optical path of the ray of squared reach r² less that along the normal, um."""
    if len(between.layers) > 1:
        extra: Tensor = interpolant.chebyshev_interpolant(
            lambda u: media.path_difference(between.layers, 0.0, 0.0, u)[1], r2
        )
        return extra
    n, d = between.layers[0]
    return n * r2 / (torch.sqrt(r2 + d * d) + d)


def cell_um(
    layers: Layers, wavelength_um: float, window_um: float, distance_um: float
) -> float:
    """Width of the cells that leave a window of this width, so far behind the lens,
    what pillars scatter into it.

    Args:
        layers: films and stop of the lens.
        wavelength_um: vacuum wavelength, um.
        window_um: side of the window, um.
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
    """The lens plane of a lens file, in cells that leave a window of this width what
    pillars scatter into it; or the
    one that was given.

    Args:
        layers: films and stop of the lens.
        window_um: side of the window, um.
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
