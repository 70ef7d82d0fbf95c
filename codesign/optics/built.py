"""The PSFs that a made lens gives to training: every pillar as built, gathered on the
pupil, on the samples of a run.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numba
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from characterize.inference import AsBuilt
from characterize.model import PLACE, parameter_vector, process_state_of
from codesign.optics.stack import OpticsConfig, PixelPsfStack, sampled_light
from metalens.core.arrays import Array
from metalens.design import Focus, profiles
from metalens.fabrication import (
    PERTURBATIONS,
    Sensitivity,
    State,
    perturbed_transmission,
    proxy_sensitivity,
)
from metalens.image import (
    Field,
    Optics,
    Pupil,
    SmoothWave,
    amplitude,
    cell_um,
    coordinates,
    view_pupil,
)
from metalens.lens import Lens
from metalens.optics.paths import path_difference, sensor_path, source_path

OF_LENS = (*(row.name for row in PERTURBATIONS), "distance_um")
TABLE_STEP_UM = 1e-5  # of the table of t over the diameter
SPARE = 4  # samples around the window, so that what wraps around does not reach it


def at_rest(x: Array) -> Array:
    """The parameters that a lens keeps when it leaves the bench; those of bench and
    light source are set to rest.

    x: all parameters, in the order of ``characterize.model.parameters.NAMES``.
    """
    return parameter_vector({name: float(x[PLACE[name]]) for name in OF_LENS})


def posterior_parameters(built: AsBuilt, count: int, *, seed: int) -> Iterator[Array]:
    """All parameters of ``count`` lenses that the fit holds possible, as far as their
    light goes.

    Args:
        built: of the fit. seed: of the random generator.
    """
    for row in built.lens_samples(count, seed=seed):
        yield built.parameters(row)


def psf_error(one: PixelPsfStack, other: PixelPsfStack) -> float:
    """Relative L2 difference of two stacks of PSFs, each PSF of sum 1.

    Args:
        one: stack to compare. other: the stack it is compared with.
    """
    a, b = (
        s.intensity.double() / s.intensity.double().sum((-2, -1), keepdim=True)
        for s in (one, other)
    )
    return float((a - b).norm() / b.norm())


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
        """The hyperbolic phase that the design aims at.

        Args:
            x_um: x on the lens. y_um: y on the lens.
        """
        return SmoothWave(self.focus, self.radius_um).carrier_rad(x_um, y_um)

    def factor(
        self, x_um: Tensor, y_um: Tensor, wavelength_um: float, angle_rad: float
    ) -> Tensor | None:
        """The cells at the rays; pillars answer as at the design wavelength and
        straight on.

        Args:
            x_um: x on the lens. y_um: y on the lens. wavelength_um: of the light.
            angle_rad: angle of the light to the axis, or of the line in the image.
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

    def pillar_transmission(self, wavelength_um: float, angle_rad: float) -> Tensor:
        """(y, x) complex t of every pillar, for the error of averaging over cells.

        Args:
            wavelength_um: of the light.
            angle_rad: angle of the light to the axis, or of the line in the image.
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


class MadeLens:
    """A design, ready to give the PSFs of any lens that was made of it.

    response: what height, index and sidewall do to the pillars; by effective index
    without it.

    Accuracy: PSFs on samples of a run differ from those of
    :func:`metalens.psf.psf_stack` over all pillars by 3e-3
    (relative L2); a test holds it.
    """

    def __init__(
        self,
        design: Lens,
        settings: OpticsConfig,
        *,
        response: Sensitivity | None = None,
    ) -> None:
        self.design, self.settings, self.response = (
            design,
            settings,
            response or proxy_sensitivity(design),
        )
        d = design.diameters
        self._field = Field(math.radians(settings.angle_deg))
        self.focus = Focus(
            design.wavelength_um, design.sensor_distance_um, design.source_distance_um
        )
        window = settings.window_samples * settings.sample_um
        width = cell_um(
            design.layers, design.wavelength_um, window, design.sensor_distance_um
        )
        self._block = max(1, round(width / d.pitch_um))
        self._rim_um = d.radius_um  # looks through all pillars
        self._diameter_um = np.ascontiguousarray(d.diameter_um, np.float32)
        self._carrier = np.empty(d.diameter_um.shape, np.complex64)
        for rows in range(0, len(d.y_um), 128):
            part = slice(rows, rows + 128)
            self._carrier[part] = np.exp(
                -1j * profiles.hyperbolic_phase(d.x_um, d.y_um[part, None], self.focus)
            )

    def stack(self, x: Array | None = None) -> PixelPsfStack:
        """PSFs at the run's field angle of the lens with these parameters; of the
        design without them.

        Args:
            x: all parameters; of the bench's own (stage, light, camera) none enters.
        """
        known = at_rest(parameter_vector() if x is None else x)
        distance = self.design.sensor_distance_um + float(known[PLACE["distance_um"]])
        pupil, tangents = self._pupil(distance), self._field.tangents
        seen = view_pupil(pupil, self._field, self.design.source_distance_um)
        x_um, y_um = seen.x_um.numpy(), seen.y_um.numpy()
        made = process_state_of(known)
        cells = self._gathered(made)
        field = torch.from_numpy(self._on_nodes(cells, x_um, y_um))
        phase = profiles.hyperbolic_phase(x_um, y_um, self.focus)
        phase = phase + self._aberration(made, x_um, y_um)
        centre = tangents[0] * distance, tangents[1] * distance
        k = 2 * math.pi / pupil.wavelength_um
        inward = torch.from_numpy(phase) + k * sensor_path(
            seen.x_um, seen.y_um, centre, distance
        )
        paths = [
            source_path(seen.x_um, seen.y_um, tangents, 1 / z)
            for z in self.settings.depths_um.tolist()
        ]
        field = field * seen.weight
        light = []
        for path in paths:
            angle = torch.remainder(inward + k * path, 2 * math.pi)
            wave = (field * torch.polar(torch.ones_like(angle), angle)).to(
                torch.complex64
            )
            grid = self.settings.sample_um, self.settings.window_samples
            light.append(sampled_light(wave, pupil, *grid))
        return PixelPsfStack(
            torch.stack(light),
            self.settings.depths_um,
            Optics(self._plane(made, cells), self.design.layers, distance),
        )

    def wave(self, x: Array | None = None) -> Array:
        """(nodes, nodes) complex wave behind the lens, its focusing phase taken off, on
        nodes of the design's pupil.

        A wrong lens-sensor distance counts as the defocus that it is. Zero beyond the
        rim.

        Args:
            x: all parameters of a lens, in the fit's order; None for the design.
        """
        known = at_rest(parameter_vector() if x is None else x)
        pupil = self._pupil(self.design.sensor_distance_um)
        nodes_x, nodes_y = (c.numpy() for c in coordinates(pupil))
        field = self._on_nodes(
            self._gathered(process_state_of(known)), nodes_x, nodes_y
        )
        r2 = nodes_x**2 + nodes_y**2
        actual = self.design.sensor_distance_um + float(known[PLACE["distance_um"]])
        paths = path_difference(r2, actual) - path_difference(
            r2, self.design.sensor_distance_um
        )
        phase = 2 * math.pi / self.design.wavelength_um * paths + self._aberration(
            process_state_of(known), nodes_x, nodes_y
        )
        return np.asarray(field * np.exp(1j * phase) * amplitude(pupil).numpy())

    def redrawn(self, lens: Lens) -> "MadeLens":
        """The same for a lens of other diameters."""
        return MadeLens(lens, self.settings, response=self.response)

    def plane(self, made: State, *, factor: Array | None = None) -> PillarCells:
        """The lens plane of a process state, as rays of any direction meet it.

        Args:
            factor: (y, x) complex, of every pillar beside the state.
            made: perturbations by the process.
        """
        return self._plane(made, self._gathered(made, factor=factor), factor)

    def pillars(self, made: State, *, factor: Array | None = None) -> Tensor:
        """(y, x) complex t of every pillar in a process state, 0 where there is none.

        Args:
            made: perturbations by the process.
            factor: (y, x) complex, of every pillar beside the state.
        """
        alone = self._gathered(made, 1, factor=factor)
        return torch.from_numpy(alone * self._carrier.conj())

    def _plane(
        self, made: State, cells: Array, factor: Array | None = None
    ) -> PillarCells:
        d, filled = self.design.diameters, _filled(cells)
        step = self._block * d.pitch_um
        half = filled.shape[1] * step / 2, filled.shape[0] * step / 2
        centre = tuple(
            float(first) - d.pitch_um / 2 + h
            for first, h in zip((d.x_um[0], d.y_um[0]), half, strict=True)
        )

        def added(x_um: Tensor, y_um: Tensor) -> Tensor:
            return torch.from_numpy(self._aberration(made, x_um.numpy(), y_um.numpy()))

        return PillarCells(
            self.focus,
            self._rim_um + d.pitch_um / 2,
            torch.from_numpy(np.stack([filled.real, filled.imag])).float(),
            half,
            d.pitch_um,
            lambda: self.pillars(made, factor=factor),
            (centre[0], centre[1]),
            added if made.has_wavefront_error() else None,
        )

    def _aberration(self, known: State, nodes_x: Array, nodes_y: Array) -> Array:
        rim = self._rim_um
        return known.phase_rad(nodes_x / rim, nodes_y / rim)

    def _pupil(self, distance_um: float) -> Pupil:
        d, s = self.design, self.settings
        rough = Pupil(
            self._rim_um + d.diameters.pitch_um / 2, distance_um, d.wavelength_um
        )
        width = (s.window_samples + SPARE) * s.sample_um
        return Pupil(
            rough.radius_um,
            distance_um,
            d.wavelength_um,
            max(64, math.ceil(width * rough.edge / d.wavelength_um) * 2),
        )

    def _gathered(
        self, known: State, block: int | None = None, *, factor: Array | None = None
    ) -> Array:
        """(cells, cells) mean of t exp(-i phase of the focus) over the pillars of each
        cell, 0 where there is none;
        block: pillars along a cell in place of the window's own."""
        d = self.design.diameters
        bias = known.bias_polynomial_um()
        reach = float(np.abs(bias).sum()) + TABLE_STEP_UM
        low = float(self._diameter_um[self._diameter_um > 0].min()) - reach
        count = int((float(self._diameter_um.max()) + reach - low) / TABLE_STEP_UM) + 2
        grid = low + TABLE_STEP_UM * np.arange(count)
        t = perturbed_transmission(
            self.design.proxy,
            self.response,
            grid,
            self.design.wavelength_um,
            known.answers(),
        )
        edges = self.response.by_edges(grid)
        u, v = d.x_um / self._rim_um, d.y_um / self._rim_um
        carrier = self._carrier if factor is None else self._carrier * factor
        table = (
            t.astype(np.complex64),
            np.empty(0, complex) if edges is None else edges,
            low,
            TABLE_STEP_UM,
        )
        return np.asarray(
            _gather(
                self._diameter_um,
                carrier.astype(np.complex64),
                *table,
                u,
                v,
                bias,
                block or self._block,
            )
        )

    def _on_nodes(self, cells: Array, nodes_x: Array, nodes_y: Array) -> Array:
        """The field of the cells at the pupil's nodes; beyond the rim it goes on as at
        the rim.
        """
        d, b = self.design.diameters, self._block
        filled = _filled(cells)
        place = [
            (nodes - (first + (b - 1) / 2 * d.pitch_um)) / (b * d.pitch_um)
            for nodes, first in ((nodes_y, d.y_um[0]), (nodes_x, d.x_um[0]))
        ]
        real, imaginary = (
            ndimage.map_coordinates(a, place, order=1, mode="nearest")
            for a in (filled.real, filled.imag)
        )
        return np.asarray(real + 1j * imaginary)


def _filled(cells: Array) -> Array:
    """Empty cells with the value of the nearest filled one."""
    rows, columns = ndimage.distance_transform_edt(
        cells == 0, return_distances=False, return_indices=True
    )
    return np.asarray(cells[rows, columns])


@numba.njit(cache=True, fastmath=True)
def _gather(diameter, carrier, table, edges, low, step, u, v, bias, block):  # type: ignore[no-untyped-def]
    """Mean of table[(D + b - low) / step] * carrier over blocks, b = sum_mn bias_mn u^m
    v^n; 0 for empty blocks.

    edges: on the same grid, of pillars that lose their form as they grow: times exp(b
    edges(D + b/2)); else empty.
    """
    rows, columns = diameter.shape
    terms = len(bias)
    along = np.zeros(terms)
    total = np.zeros(
        ((rows + block - 1) // block, (columns + block - 1) // block), np.complex128
    )
    count = np.zeros(total.shape, np.int64)
    for i in range(rows):
        for m in range(terms):
            along[m] = 0.0
            for n in range(terms - 1, -1, -1):
                along[m] = along[m] * v[i] + bias[m, n]
        for j in range(columns):
            d = diameter[i, j]
            if d > 0:
                b = along[terms - 1]
                for m in range(terms - 2, -1, -1):
                    b = b * u[j] + along[m]
                value = table[int((d + b - low) / step + 0.5)] * carrier[i, j]
                if edges.size > 0:
                    value = value * np.exp(
                        b * edges[int((d + b / 2 - low) / step + 0.5)]
                    )
                total[i // block, j // block] += value
                count[i // block, j // block] += 1
    return np.where(count > 0, total / np.maximum(count, 1), 0)
