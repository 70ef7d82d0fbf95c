"""The device: pillars on a lattice before their sensor as a true image, any one cause
changed or left out.

All images of a device share one plan of field points, depths and wavelengths and one
set of kernels, so that two of
them differ by the cause and not by how either was approximated.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from metalens.design import Focus
from metalens.image import (
    Grid,
    Imager,
    Optics,
    Plan,
    SmoothWave,
    Wave,
    cell_um,
    node_light,
    normalised,
    with_psfs,
)
from metalens.image import imager as field_imager
from metalens.lens import Layers, Lens
from metalens.psf import Source, SpectralNodes, among

ROWS = 256  # of pillars at a time


@dataclass(frozen=True, eq=False, slots=True)
class PillarCells:
    """A lens plane of given pillars: mean of t exp(-i focus) over cells of a few
    micrometres, interpolated to the rays.

    cells: (2, y, x) real and imaginary part. half_um, centre_um: (x, y) half width of
    the cells, and their middle.
    pillars: gives (y, x) the complex t of each, 0 where there is none, pitch_um apart
    about the axis.
    added_rad: (x_um, y_um) to a phase that bends the wave front as a whole; None for
    none.
    """

    focus: Focus
    radius_um: float
    cells: Tensor
    half_um: tuple[float, float]
    pitch_um: float
    pillars: Callable[[], Tensor]
    centre_um: tuple[float, float] = (0.0, 0.0)
    added_rad: Callable[[Tensor, Tensor], Tensor] | None = None

    def carrier_rad(self, x_um: Tensor, y_um: Tensor) -> Tensor:
        """The hyperbolic phase that the design aims at."""
        return SmoothWave(self.focus, self.radius_um).carrier_rad(x_um, y_um)

    def factor(
        self, x_um: Tensor, y_um: Tensor, wavelength_um: float, angle_rad: float
    ) -> Tensor | None:
        """The cells at the rays; pillars answer as at the design wavelength and
        straight on.
        """
        at = (
            (v - c) / h
            for v, c, h in zip((x_um, y_um), self.centre_um, self.half_um, strict=True)
        )
        place = torch.stack(list(at), -1).to(self.cells)
        found = torch.nn.functional.grid_sample(
            self.cells[None],
            place.reshape(1, 1, -1, 2),
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
        )
        return self._bent(
            torch.complex(*found.reshape(2, *x_um.shape).unbind(0)), x_um, y_um
        )

    def answer(self, wavelength_um: float, angle_rad: float) -> Tensor:
        """(y, x) complex t of every pillar, by which the error of gathering them is
        told.
        """
        t = self.pillars()
        y, x = (
            (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * self.pitch_um
            for n in t.shape
        )
        return self._bent(t, *torch.meshgrid(x, y, indexing="xy"))

    def _bent(self, t: Tensor, x_um: Tensor, y_um: Tensor) -> Tensor:
        """With the added phase at these places."""
        if self.added_rad is None:
            return t
        added = torch.remainder(self.added_rad(x_um, y_um), 2 * math.pi).to(
            torch.float32
        )
        return t * torch.polar(torch.ones_like(added), added)


def gather_lens_plane(
    lens: Lens, phase: Tensor, level: Tensor, *, window_um: float
) -> PillarCells:
    """The lens plane of pillars of these phases and amplitudes.

    Args:
        phase, level: (y, x) of every site, float32; level 0 where there is no pillar.
            Taken one by one: unlike
            neighbours are put on here, where the lens holds their rows.
        window_um: of the PSFs, which says over how many pillars the mean may be
            (:func:`metalens.image.cell_um`).
    """
    d = lens.diameters
    radius = d.radius_um + d.pitch_um / 2
    focus = Focus(
        lens.wavelength_um,
        lens.sensor_distance_um,
        lens.source_distance_um,
        lens.layers,
    )
    width = cell_um(lens.layers, lens.wavelength_um, window_um, lens.sensor_distance_um)
    smooth, block = SmoothWave(focus, radius), max(1, round(width / d.pitch_um))
    x = torch.as_tensor(d.x_um, dtype=torch.float64)
    factor = None
    if lens.neighbours is not None:
        factor = among.mean_coupling(
            torch.polar(level, phase), lens.neighbours, d.pitch_um
        )
    parts = []
    for rows in range(0, len(d.y_um), ROWS):
        part = slice(rows, rows + ROWS)
        ideal = smooth.carrier_rad(
            x, torch.as_tensor(d.y_um[part], dtype=torch.float64)[:, None]
        )
        rest = torch.remainder(phase[part].double() - ideal, 2 * math.pi).float()
        whole = torch.polar(level[part], rest)
        if factor is not None:
            whole = whole * factor[part]
        parts.append(torch.stack([whole.real, whole.imag, (level[part] > 0).float()]))
    cells = _averaged(torch.cat(parts, 1), block)
    half_y, half_x = (n * block * d.pitch_um / 2 for n in cells.shape[-2:])
    # half a pitch past the lens's middle where one row or column more is added behind
    # it
    past_y, past_x = ((-n) % block % 2 * d.pitch_um / 2 for n in phase.shape)

    def pillars() -> Tensor:
        t = torch.polar(level, phase)
        return t if factor is None else t * factor

    return PillarCells(
        focus, radius, cells, (half_x, half_y), d.pitch_um, pillars, (past_x, past_y)
    )


def _averaged(layers: Tensor, block: int) -> Tensor:
    """(2, cells, cells) mean of the first two layers where the third, whether a pillar
    stands, is 1.
    """
    spare = [(-n) % block for n in layers.shape[-2:]]
    pad = (
        spare[1] // 2,
        spare[1] - spare[1] // 2,
        spare[0] // 2,
        spare[0] - spare[0] // 2,
    )
    mean = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad(layers, pad)[None], block
    )[0]
    near = torch.nn.functional.avg_pool2d(mean[None], 3, stride=1, padding=1)[0]
    filled = torch.where(mean[2] > 0, mean[:2], near[:2])
    return filled / torch.where(mean[2] > 0, mean[2], near[2]).clamp_min(1e-12)


@dataclass(eq=False)
class ImagingDevice:
    """A lens plane, its films and its sensor, imaged truly over field, depth and
    spectrum.
    """

    wave: Wave
    layers: Layers
    distance_um: float
    whole: Imager = field(repr=False)
    tolerance: float

    @property
    def window_um(self) -> float:
        """Width of the PSFs."""
        return self.whole.grid.window * self.whole.grid.step_um

    @property
    def above(self) -> str:
        """Why the error of the image is above its tolerance; empty where it is not."""
        return self.whole.above(self.tolerance)

    def image(
        self,
        *,
        wave: Wave | None = None,
        layers: Layers | None = None,
        shift_um: float = 0.0,
    ) -> Imager:
        """The image with another lens plane, other films, or the sensor moved away by
        ``shift_um``.
        """
        return self._imaged(
            Optics(
                wave or self.wave, layers or self.layers, self.distance_um + shift_um
            )
        )

    @torch.no_grad()
    def _imaged(self, optics: Optics, plan: Plan | None = None) -> Imager:
        nodes = plan or self.whole.plan
        return with_psfs(
            self.whole, *normalised(node_light(optics, nodes).detach(), optics, nodes)
        )

    def one_psf(self) -> Imager:
        """The image by the PSFs of the middle of the field alone."""
        rows, columns = (n // 2 for n in self.whole.stack.shape[:2])
        stack = self.whole.stack[rows, columns].expand_as(self.whole.stack).contiguous()
        return with_psfs(self.whole, stack, self.whole.energy)

    def evenly_lit(self) -> Imager:
        """The image of a lens that collects as much light from every direction: no
        cos⁴, no vignetting.
        """
        level = self.whole.energy.mean().expand_as(self.whole.energy).contiguous()
        return with_psfs(self.whole, self.whole.stack, level)

    def one_wavelength(self, wavelength_um: float) -> Imager:
        """The image in light of one wavelength."""
        plan = replace(
            self.whole.plan,
            waves=SpectralNodes(np.array([wavelength_um]), np.ones(1), 0.0),
        )
        return self._imaged(Optics(self.wave, self.layers, self.distance_um), plan)

    def both_polarisations(self) -> Imager:
        """The image by the flux of both polarisations of light whose rays the lens
        turns; the device's own where it
        is that already.

        What they change is computed on a grid of at most 5 x 5 field points and
        interpolated: it is small and smooth.
        """
        plan, optics = self.whole.plan, Optics(self.wave, self.layers, self.distance_um)
        if plan.window.components:
            return self.whole
        y, x = (_few(axis) for axis in (plan.y_um, plan.x_um))
        light = node_light(optics, plan).detach()
        with torch.no_grad():
            scalar, both = (
                replace(
                    plan, y_um=y, x_um=x, window=replace(plan.window, components=count)
                )
                for count in (0, plan.window.whole)
            )
            change = (
                node_light(optics, both).detach() - node_light(optics, scalar).detach()
            )
            to_y, to_x = (
                _hats(wanted, axis).to(change)
                for wanted, axis in ((plan.y_um, y), (plan.x_um, x))
            )
            light = light + torch.einsum("ya,xb,abzhw->yxzhw", to_y, to_x, change)
            return with_psfs(self.whole, *normalised(light, optics, plan))


def make_device(
    wave: Wave,
    grid: Grid,
    *,
    layers: Layers,
    distance_um: float,
    spectrum: Source | None = None,
    field_rad: float = 0.0,
    tolerance: float = 0.03,
) -> ImagingDevice:
    """A device whose image is prepared.

    Raises:
        SceneError, PropagationError: as :func:`metalens.image.imager`.
    """
    with torch.no_grad():
        whole = field_imager(
            wave, grid, spectrum=spectrum, layers=layers, field=(field_rad, 0.0), tolerance=tolerance,
            distance_um=distance_um,
        )  # fmt: skip
    return ImagingDevice(wave, layers, distance_um, whole, tolerance)


def _few(axis: Tensor) -> Tensor:
    """At most five places from the first to the last."""
    return torch.linspace(
        float(axis[0]), float(axis[-1]), min(5, len(axis)), dtype=axis.dtype
    )


def _hats(wanted: Tensor, axis: Tensor) -> Tensor:
    """(wanted, axis) weights of the linear interpolation between evenly spaced places."""
    return (1 - (wanted[:, None] - axis).abs() / (axis[1] - axis[0])).clamp_min(0)


def image_difference(one: Imager, other: Imager) -> float:
    """Relative L2 difference of the PSFs of two images over field and depth, each PSF
    of sum 1.
    """
    return float((one.stack - other.stack).norm() / other.stack.norm())
