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
from characterize.model import PLACE, as_built, parameter_vector, process_state_of
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
    cell_um,
    interpolate_cells,
    view_pupil,
)
from metalens.lens import Lens
from metalens.optics.paths import sensor_path, source_path

OF_LENS = (*(row.name for row in PERTURBATIONS), "distance_um")
TABLE_STEP_UM = 1e-5  # of the table of t over the diameter
SPARE = 4  # samples around the window, so that what wraps around does not reach it


def at_rest(x: Array) -> Array:
    """All parameters with those of bench and light source reset to their defaults.

    What a lens keeps when it leaves the bench: the process and its sensor distance.

    x: all parameters, in the order of ``characterize.model.parameters.NAMES``.
    """
    return parameter_vector({name: float(x[PLACE[name]]) for name in OF_LENS})


def posterior_parameters(built: AsBuilt, count: int, *, seed: int) -> Iterator[Array]:
    """All parameters of ``count`` lenses drawn from the posterior of a fit.

    Args:
        built: of the fit. seed: of the random generator.
    """
    for row in built.lens_samples(count, seed=seed):
        yield built.parameters(row)


def psf_error(one: PixelPsfStack, other: PixelPsfStack) -> float:
    """Relative L2 difference |a - b| / |b| of two PSF stacks, each PSF of sum 1.

    Args:
        one: stack to compare. other: the reference.
    """
    a, b = (
        s.intensity.double() / s.intensity.double().sum((-2, -1), keepdim=True)
        for s in (one, other)
    )
    return float((a - b).norm() / b.norm())


@dataclass(frozen=True, eq=False, slots=True)
class PillarCells:
    """Lens plane of individual pillars: mean of t exp(-i focus) over cells of some um.

    The cells are interpolated to the rays.

    cells: (2, y, x) real and imaginary part. half_um, centre_um: (x, y) half width of
    the cell array, and its centre. pillars: returns (y, x) the complex t of each, 0
    where there is none, pitch_um apart about the axis, the added phase included.
    added_rad: (x_um, y_um) to a phase of the wave front as a whole; None for none.
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
    ) -> Tensor:
        """Complex transmission at the rays, without the focus: cells by linear
        interpolation.

        Pillars respond as at the design wavelength and normal incidence.

        Args:
            x_um: x on the lens. y_um: y on the lens. wavelength_um: of the light.
            angle_rad: angle of the light to the axis.
        """
        t = interpolate_cells(self.cells, (x_um, y_um), self.centre_um, self.half_um)
        if self.added_rad is None:
            return t
        added = torch.remainder(self.added_rad(x_um, y_um), 2 * math.pi).float()
        return t * torch.polar(torch.ones_like(added), added)

    def pillar_transmission(self, wavelength_um: float, angle_rad: float) -> Tensor:
        """(y, x) complex t of every pillar, for the error of averaging over cells.

        Args:
            wavelength_um: of the light. angle_rad: angle of the light to the axis.
        """
        return self.pillars()


class MadeLens:
    """A design that returns the PSFs of any lens fabricated from it.

    response: sensitivity of the pillars to height, index and sidewall; by effective
    index without it.

    Accuracy: PSFs on samples of a run differ from those of
    :func:`metalens.psf.psf_stack` over all pillars by 3e-3 (relative L2); a test checks
    it.
    """

    def __init__(
        self,
        design: Lens,
        settings: OpticsConfig,
        *,
        response: Sensitivity | None = None,
    ) -> None:
        self.design = design
        self.settings = settings
        self.response = response or proxy_sensitivity(design)
        d = design.diameters
        self._field = Field(math.radians(settings.angle_deg))
        self.focus = Focus(
            design.wavelength_um, design.sensor_distance_um, design.source_distance_um
        )
        window_um = settings.window_samples * settings.sample_um
        cell_width_um = cell_um(
            design.layers, design.wavelength_um, window_um, design.sensor_distance_um
        )
        self._block = max(1, round(cell_width_um / d.pitch_um))
        self._rim_um = d.radius_um  # a search through all pillars
        self._diameter_um = np.ascontiguousarray(d.diameter_um, np.float32)
        self._carrier = np.empty(d.diameter_um.shape, np.complex64)
        for rows in range(0, len(d.y_um), 128):
            part = slice(rows, rows + 128)
            self._carrier[part] = np.exp(
                -1j * profiles.hyperbolic_phase(d.x_um, d.y_um[part, None], self.focus)
            )

    def stack(self, x: Array | None = None) -> PixelPsfStack:
        """PSFs at the run's field angle of the lens of these parameters.

        The wave on the pupil is t exp(i (focus + wave front + k (sensor path + source
        path))), one source path a depth.

        Args:
            x: all parameters; None for the design. Those of the bench (stage, light,
                camera) are ignored.
        """
        parameters = at_rest(parameter_vector() if x is None else x)
        distance_um = self.design.sensor_distance_um + float(
            parameters[PLACE["distance_um"]]
        )
        pupil = self._pupil(distance_um)
        tangents = self._field.tangents
        view = view_pupil(pupil, self._field, self.design.source_distance_um)
        place_um = view.x_um, view.y_um
        state = process_state_of(parameters)
        plane = self.plane(state)
        light_in = self.design.wavelength_um, self._field.angle_rad
        transmission = plane.factor(*place_um, *light_in) * view.weight
        centre_um = tangents[0] * distance_um, tangents[1] * distance_um
        k = 2 * math.pi / pupil.wavelength_um
        lens_phase = plane.carrier_rad(*place_um) + k * sensor_path(
            *place_um, centre_um, distance_um
        )
        source_paths = [
            source_path(*place_um, tangents, 1 / z)
            for z in self.settings.depths_um.tolist()
        ]
        light = []
        for source in source_paths:
            angle = torch.remainder(lens_phase + k * source, 2 * math.pi)
            wave = (transmission * torch.polar(torch.ones_like(angle), angle)).to(
                torch.complex64
            )
            grid = self.settings.sample_um, self.settings.window_samples
            light.append(sampled_light(wave, pupil, *grid))
        return PixelPsfStack(
            torch.stack(light),
            self.settings.depths_um,
            Optics(plane, self.design.layers, distance_um),
        )

    def redrawn(self, lens: Lens) -> "MadeLens":
        """The same settings and response for a lens of other diameters."""
        return MadeLens(lens, self.settings, response=self.response)

    def plane(self, state: State, *, factor: Array | None = None) -> PillarCells:
        """Lens plane of a process state, for rays of any direction.

        Args:
            state: perturbations by the process.
            factor: (y, x) complex, multiplies every pillar.
        """
        d = self.design.diameters
        filled = _filled(self._gathered(state, factor=factor))
        step_um = self._block * d.pitch_um
        half_um = filled.shape[1] * step_um / 2, filled.shape[0] * step_um / 2
        centre_um = tuple(
            float(first) - d.pitch_um / 2 + h
            for first, h in zip((d.x_um[0], d.y_um[0]), half_um, strict=True)
        )

        def added_rad(x_um: Tensor, y_um: Tensor) -> Tensor:
            place = (x_um / self._rim_um).numpy(), (y_um / self._rim_um).numpy()
            return torch.from_numpy(state.phase_rad(*place))

        def pillars() -> Tensor:
            t = self.pillars(state, factor=factor)
            added = as_built.on_pillars(d, state.phase_rad)
            return t * torch.from_numpy(np.exp(1j * added).astype(np.complex64))

        return PillarCells(
            self.focus,
            self._rim_um + d.pitch_um / 2,
            torch.from_numpy(np.stack([filled.real, filled.imag])).float(),
            half_um,
            d.pitch_um,
            pillars,
            (centre_um[0], centre_um[1]),
            added_rad if state.has_wavefront_error() else None,
        )

    def pillars(self, state: State, *, factor: Array | None = None) -> Tensor:
        """(y, x) complex t of every pillar in a process state, 0 where there is none.

        Args:
            state: perturbations by the process.
            factor: (y, x) complex, multiplies every pillar.
        """
        single = self._gathered(state, 1, factor=factor)
        return torch.from_numpy(single * self._carrier.conj())

    def _pupil(self, distance_um: float) -> Pupil:
        """Pupil at a sensor distance, with nodes for the window and a margin of
        SPARE samples.
        """
        d, s = self.design, self.settings
        rough = Pupil(
            self._rim_um + d.diameters.pitch_um / 2, distance_um, d.wavelength_um
        )
        width_um = (s.window_samples + SPARE) * s.sample_um
        return Pupil(
            rough.radius_um,
            distance_um,
            d.wavelength_um,
            max(64, math.ceil(width_um * rough.edge / d.wavelength_um) * 2),
        )

    def _gathered(
        self, state: State, block: int | None = None, *, factor: Array | None = None
    ) -> Array:
        """(cells, cells) mean of t exp(-i phase of the focus) over the pillars of each
        cell.

        0 where a cell has no pillar. t is read from a table over the diameter, in steps
        of TABLE_STEP_UM.

        Args:
            block: pillars along a cell; None for that of the window.
            factor: (y, x) complex, multiplies every pillar.
        """
        d = self.design.diameters
        bias = state.bias_polynomial_um()
        margin_um = float(np.abs(bias).sum()) + TABLE_STEP_UM
        low = float(self._diameter_um[self._diameter_um > 0].min()) - margin_um
        count = (
            int((float(self._diameter_um.max()) + margin_um - low) / TABLE_STEP_UM) + 2
        )
        grid = low + TABLE_STEP_UM * np.arange(count)
        t = perturbed_transmission(
            self.design.proxy,
            self.response,
            grid,
            self.design.wavelength_um,
            state.response_amounts(),
        )
        edges = self.response.by_edges(grid)
        u, v = d.x_um / self._rim_um, d.y_um / self._rim_um
        carrier = self._carrier if factor is None else self._carrier * factor
        means = _gather(
            self._diameter_um,
            carrier.astype(np.complex64),
            t.astype(np.complex64),
            np.empty(0, complex) if edges is None else edges,
            low,
            TABLE_STEP_UM,
            u,
            v,
            bias,
            block or self._block,
        )
        return np.asarray(means)


def _filled(cells: Array) -> Array:
    """Cells with every empty one set to the value of the nearest filled cell."""
    rows, columns = ndimage.distance_transform_edt(
        cells == 0, return_distances=False, return_indices=True
    )
    return np.asarray(cells[rows, columns])


@numba.njit(cache=True, fastmath=True)
def _gather(diameter, carrier, table, edges, low, step, u, v, bias, block):  # type: ignore[no-untyped-def]
    """Mean transmission times carrier over blocks of ``block`` x ``block`` pillars.

    The mean of table[(D + b - low) / step] * carrier, b = sum_mn bias_mn u^m v^n in um
    by Horner's rule. Diameter 0 is no pillar; blocks without one are 0.

    Args:
        diameter: (y, x) um. carrier: (y, x) complex. table: t over the diameter,
            complex.
        edges: on the same grid, for pillars that change form as they grow: factor
            exp(b edges(D + b/2)); else empty.
        low, step: first diameter of the table and its step, um.
        u, v: (x,) and (y,) coordinates over the radius. bias: (terms, terms) um.
    """
    rows, columns = diameter.shape
    terms = len(bias)
    row_bias = np.zeros(terms)
    total = np.zeros(
        ((rows + block - 1) // block, (columns + block - 1) // block), np.complex128
    )
    pillars = np.zeros(total.shape, np.int64)
    for i in range(rows):
        for m in range(terms):
            row_bias[m] = 0.0
            for n in range(terms - 1, -1, -1):
                row_bias[m] = row_bias[m] * v[i] + bias[m, n]
        for j in range(columns):
            d = diameter[i, j]
            if d > 0:
                bias_um = row_bias[terms - 1]
                for m in range(terms - 2, -1, -1):
                    bias_um = bias_um * u[j] + row_bias[m]
                value = table[int((d + bias_um - low) / step + 0.5)] * carrier[i, j]
                if edges.size > 0:
                    value = value * np.exp(
                        bias_um * edges[int((d + bias_um / 2 - low) / step + 0.5)]
                    )
                total[i // block, j // block] += value
                pillars[i // block, j // block] += 1
    return np.where(pillars > 0, total / np.maximum(pillars, 1), 0)
