"""PSFs of a fabricated lens on the samples of a run, by means of the pillars over
cells of the pupil.
"""

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from characterize.model import PLACE, as_built, parameter_vector, process_state_of
from codesign.optics.stack import OpticsConfig, PixelPsfStack, psfs_over_depth
from metalens.core.arrays import Array
from metalens.design import Focus, profiles
from metalens.fabrication import PERTURBATIONS, Sensitivity, State, proxy_sensitivity
from metalens.image import Optics, SmoothWave, cell_um, interpolate_cells
from metalens.lens import Lens

OF_PROCESS = [PLACE[row.name] for row in PERTURBATIONS]


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

    Pillars respond as at the design wavelength and normal incidence.

    t: (y, x) complex transmission of every pillar, 0 where there is none, pitch_um
    apart about the axis. cells: (2, y, x) real and imaginary part of the means.
    centre_um, half_um: (x, y) centre of the cell array, and its half width.
    """

    focus: Focus
    radius_um: float
    t: Tensor
    pitch_um: float
    cells: Tensor
    centre_um: tuple[float, float]
    half_um: tuple[float, float]

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

        Args:
            x_um: x on the lens. y_um: y on the lens. wavelength_um: of the light.
            angle_rad: angle of the light to the axis.
        """
        return interpolate_cells(self.cells, (x_um, y_um), self.centre_um, self.half_um)

    def pillar_transmission(self, wavelength_um: float, angle_rad: float) -> Tensor:
        """(y, x) complex t of every pillar, for the error of averaging over cells.

        Args:
            wavelength_um: of the light. angle_rad: angle of the light to the axis.
        """
        return self.t


@dataclass(eq=False)
class MadeLens:
    """A design that returns the PSFs of any lens fabricated from it.

    response: sensitivity of the pillars to height, index and sidewall; by effective
    index without it.

    Accuracy: PSFs on samples of a run differ from those of
    :func:`metalens.psf.psf_stack` over all pillars by 3e-3 (relative L2); a test checks
    it.
    """

    design: Lens
    settings: OpticsConfig
    _: KW_ONLY
    response: Sensitivity = None  # type: ignore[assignment]  # set below

    def __post_init__(self) -> None:
        design, settings = self.design, self.settings
        self.response = self.response or proxy_sensitivity(design)
        d = design.diameters
        self.focus = Focus(
            design.wavelength_um, design.sensor_distance_um, design.source_distance_um
        )
        window_um = settings.window_samples * settings.sample_um
        cell_width_um = cell_um(
            design.layers, design.wavelength_um, window_um, design.sensor_distance_um
        )
        self._block = max(1, round(cell_width_um / d.pitch_um))
        self._carrier = np.empty(d.diameter_um.shape, np.complex64)
        for rows in range(0, len(d.y_um), 128):
            part = slice(rows, rows + 128)
            self._carrier[part] = np.exp(
                -1j * profiles.hyperbolic_phase(d.x_um, d.y_um[part, None], self.focus)
            )

    def stack(self, x: Array | None = None) -> PixelPsfStack:
        """PSFs at the run's field angle of the lens of these parameters.

        Args:
            x: all parameters; None for the design. Those of the bench (stage, light,
                camera) are ignored.
        """
        design, settings = self.design, self.settings
        parameters = parameter_vector() if x is None else x
        distance_um = design.sensor_distance_um + float(
            parameters[PLACE["distance_um"]]
        )
        plane = self.plane(process_state_of(parameters))
        pupil = replace(
            settings.pupil, radius_um=plane.radius_um, sensor_distance_um=distance_um
        )
        rows = torch.arange(settings.depth_count)
        return PixelPsfStack(
            psfs_over_depth(settings, plane, pupil, rows),
            settings.depths_um,
            Optics(plane, design.layers, distance_um),
        )

    def plane(self, state: State, *, factor: Array | None = None) -> PillarCells:
        """Lens plane of a process state, for rays of any direction.

        Args:
            state: perturbations by the process.
            factor: (y, x) complex, multiplies every pillar.
        """
        d = self.design.diameters
        t = self.pillars(state, factor=factor)
        cells = self._cell_means(t.numpy() * self._carrier)
        y_half, x_half = (n * self._block * d.pitch_um / 2 for n in cells.shape)
        return PillarCells(
            self.focus,
            d.radius_um + d.pitch_um / 2,
            t,
            d.pitch_um,
            torch.from_numpy(np.stack([cells.real, cells.imag])).float(),
            (
                float(d.x_um[0]) - d.pitch_um / 2 + x_half,
                float(d.y_um[0]) - d.pitch_um / 2 + y_half,
            ),
            (x_half, y_half),
        )

    def pillars(self, state: State, *, factor: Array | None = None) -> Tensor:
        """(y, x) complex t of every pillar in a process state, 0 where there is none.

        Args:
            state: perturbations by the process.
            factor: (y, x) complex, multiplies every pillar.
        """
        x = parameter_vector()
        x[OF_PROCESS] = state.amounts
        t = as_built.as_built_transmission(self.design, self.response, x)
        return torch.from_numpy(t if factor is None else t * factor).to(torch.complex64)

    def _cell_means(self, t: Array) -> Array:
        """(cells, cells) mean of (y, x) values over the pillars of each cell; an empty
        cell has the mean of the nearest one that is not.
        """
        starts = [np.arange(0, n, self._block) for n in t.shape]

        def cell_sums(values: Array) -> Array:
            rows = np.add.reduceat(values, starts[0], axis=0)
            return np.add.reduceat(rows, starts[1], axis=1)

        count = cell_sums((self.design.diameters.diameter_um > 0).astype(float))
        rows, columns = ndimage.distance_transform_edt(
            count == 0, return_distances=False, return_indices=True
        )
        means = cell_sums(t) / np.maximum(count, 1)
        return np.asarray(means[rows, columns])
