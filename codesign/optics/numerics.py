"""The optics of a lens file as kernels for images, with every number of the chain open
to change.

Pillars are looked up in a table t(D), so that another response of the pillars, another
diameter, or a bias that varies
over the lens costs one look-up; the PSF engine then does the rest at the settings asked
for.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.image import PsfBasis, scene
from metalens.lens import Lens
from metalens.psf import Source, SpectralNodes, integrate_pixels, psf_stack, spectrum

ENTRIES = 8192  # of the table of diameters
SLACK_UM = 0.012  # that the table reaches beyond the pillars, for bias
TEXTURE_STEP_UM = 0.85  # finest sample of intensity


@dataclass(frozen=True, slots=True)
class OpticsNumerics:
    """How finely the optics are computed.

    depth_count: PSFs over depth, at equal steps of 1/z. wavelength_count: over the
    diode's line.
    psf_tolerance: of the PSF engine. basis_tolerance: of the few kernels that stand for
    all depths.
    """

    depth_count: int = 24
    wavelength_count: int = 1
    psf_tolerance: float = 1e-4
    basis_tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if self.depth_count < 2 or self.wavelength_count < 1:
            raise LensError(
                f"{self.depth_count} depths, {self.wavelength_count} wavelengths: need 2 depths, 1 wavelength or more"
            )


@dataclass(frozen=True, slots=True)
class ImageWindow:
    """What is seen of the PSFs: nearest and farthest depth, pixels of the image, width
    of the kernels.
    """

    near_um: float
    far_um: float
    pitch_um: float = 18.0
    width_um: float = 216.0

    def depths_um(self, count: int) -> Array:
        """(count,) ascending, at equal steps of 1/z."""
        return np.asarray(1 / np.linspace(1 / self.near_um, 1 / self.far_um, count))


class TabulatedLens:
    """A lens as places in a table of diameters.

    diameter_um: (entries,) of the table. place: (y, x) into it, -1 where there is no
    pillar.

    Raises:
        LensError: another lattice than a square one, or turned pillars.
    """

    def __init__(self, lens: Lens) -> None:
        d = lens.diameters.diameter_um
        if not lens.diameters.plain:
            raise LensError(
                f"pillars on a {lens.diameters.lattice.kind} lattice: need a square one, none turned"
            )
        built = d[d > 0]
        low, high = float(built.min()) - SLACK_UM, float(built.max()) + SLACK_UM
        self.lens = lens
        self.diameter_um = np.linspace(
            low, min(high, 0.999 * lens.diameters.pitch_um), ENTRIES
        )
        self.step_um = float(self.diameter_um[1] - self.diameter_um[0])
        place = np.rint((d - self.diameter_um[0]) / self.step_um).astype(np.int32)
        self.place = np.where(d > 0, place, -1)

    @property
    def share(self) -> Array:
        """(entries,) share of the pillars that have each diameter."""
        counts = np.bincount(self.place[self.place >= 0], minlength=ENTRIES)
        return np.asarray(counts / counts.sum())

    def designed(self) -> Array:
        """(entries,) complex t of the lens's own proxy; beyond its domain the end
        holds.
        """
        inside = np.clip(self.diameter_um, *self.lens.proxy.domain_um)
        wave = self.lens.wavelength_um
        level = self.lens.proxy.transmission(inside, wave)
        return np.asarray(level * np.exp(1j * self.lens.proxy.phase_rad(inside, wave)))

    def rounded(self, table: Array, step_um: float) -> Array:
        """The table with every diameter rounded to a step, as a mask holds it."""
        made = np.rint(self.diameter_um / step_um) * step_um
        real, imaginary = (
            np.interp(made, self.diameter_um, part) for part in (table.real, table.imag)
        )
        return np.asarray(real + 1j * imaginary)

    def maps(
        self, table: Array, *, bias_um: Array | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(y, x) phase and |t|, float32, from a table; ``bias_um`` (y, x) or a number
        is added to the diameters.
        """
        place = self.place
        if bias_um is not None:
            moved = place + np.rint(np.asarray(bias_um) / self.step_um).astype(np.int32)
            place = np.where(place >= 0, np.clip(moved, 0, ENTRIES - 1), -1)
        closed = np.concatenate([table, [0]])  # place -1
        phase, level = (
            np.angle(closed).astype(np.float32),
            np.abs(closed).astype(np.float32),
        )
        return torch.from_numpy(phase[place]), torch.from_numpy(level[place])

    def turn_sine(self) -> Array:
        """(y, x) sine by which the lens turns light from its design source to the
        sensor.
        """
        d = self.lens.diameters
        r = np.hypot(d.x_um, d.y_um[:, None])
        source, sensor = self.lens.source_distance_um, self.lens.sensor_distance_um
        behind = 0.0 if math.isinf(source) else np.sin(np.arctan(r / source))
        return np.asarray(np.sin(np.arctan(r / sensor)) + behind)


def spectral_line_nodes(lens: Lens, fwhm_nm: float, count: int) -> SpectralNodes:
    """Wavelengths and weights of a diode about the design wavelength; one for a width
    of 0.
    """
    if fwhm_nm == 0 or count == 1:
        return SpectralNodes(np.array([lens.wavelength_um]), np.ones(1), 0.0)
    um, share = spectrum.spectral_weight(Source(lens.wavelength_um * 1e3, fwhm_nm))
    waves, weights = spectrum.gauss_rule(um, share, count)
    return SpectralNodes(waves, weights, math.nan)


def pixel_kernels(
    lens: Lens,
    maps: tuple[torch.Tensor, torch.Tensor],
    numerics: OpticsNumerics,
    window: ImageWindow,
    *,
    fwhm_nm: float = 0.0,
) -> PsfBasis:
    """PSFs on the pixel grid, of sum 1, as a few kernels.

    Pillars answer at every wavelength as at the design wavelength: over a diode's line
    their dispersion changes a
    PSF far less than that of diffraction does.

    Raises:
        PropagationError: as :func:`metalens.psf.psf_stack`.
    """
    nodes = spectral_line_nodes(lens, fwhm_nm, numerics.wavelength_count)
    depths = window.depths_um(numerics.depth_count)
    fine, size = (
        math.ceil(window.pitch_um / TEXTURE_STEP_UM),
        2 * math.ceil(window.width_um / (2 * window.pitch_um)),
    )
    phase, level = (m.expand(len(nodes.weights), *m.shape) for m in maps)
    stack = psf_stack(
        phase,
        level,
        pitch_um=lens.diameters.pitch_um,
        wavelength_um=nodes.wavelengths_um.tolist(),
        weights=nodes.weights.tolist(),
        sensor_distance_um=lens.sensor_distance_um,
        depths_um=depths,
        window_um=size * window.pitch_um,
        samples=size * fine,
        tolerance=numerics.psf_tolerance,
    )
    light = torch.as_tensor(stack.intensity).reshape(
        len(depths), size * fine, size * fine
    )
    pixels = integrate_pixels(
        light,
        window.pitch_um / fine,
        pitch_um=window.pitch_um,
        shape=(size + 1, size + 1),
    )
    unit = pixels / pixels.sum((1, 2), keepdim=True)
    return scene.basis(
        unit, torch.from_numpy(depths), tolerance=numerics.basis_tolerance
    )


def psf_difference(
    one: PsfBasis, other: PsfBasis, window: ImageWindow, *, depths: int = 25
) -> float:
    """Relative L2 difference of two bases' PSFs, root mean square over depths between
    their nodes too.
    """
    at = torch.from_numpy(window.depths_um(depths)).reshape(-1, 1)
    a, b = (
        torch.einsum(
            "rn,ryx->nyx", scene.weight_maps(p, at)[..., 0], p.kernels
        ).double()
        for p in (one, other)
    )
    return float(((a - b).pow(2).sum((1, 2)) / b.pow(2).sum((1, 2))).mean().sqrt())
