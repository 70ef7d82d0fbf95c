"""Forward model of phase retrieval: through-focus images of a bead by any objective,
and their derivatives.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import ndimage

from characterize.captures.capture import read_images
from characterize.model import detector
from characterize.pupil import zernike
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, FitError

_BLOCK = 1 << 22  # samples of the fields that are formed at once
# relative standard deviation of the prior of optics that may be fitted: catalogues
RELATIVE_PRIOR = {
    "numerical_aperture": 0.1,
    "index": 0.03,
    "pixel_um": 0.1,
    "step_um": 0.1,
}


@dataclass(frozen=True, slots=True)
class PupilSpec:
    """What is known of the microscope or lens; TOML of ``metalens fit --pupil``.

    numerical_aperture: on the object side, below ``index``.
    wavelength_um: in vacuum, of the light; pixel_um: in object space (sensor pixel over
    magnification).
    index: of the medium between bead and lens.
    step_um: stage step, used where the capture has no positions.
    bead_um: diameter of a uniformly fluorescent bead (0: a point).
    window: pixels of the square that is fitted, centred on the bead; center: its (row,
    column), default: the brightest spot.
    phase_order, amplitude_order: highest radial Zernike order of phase and of
    log-amplitude.
    drift_order: degree of the lateral drift as a polynomial of the stage position.
    stage_sigma_um: standard deviation of the axial stage error of a plane: a tenth of
    the step without it, 0 for a stage that is believed.
    model: vector or scalar; auto takes vector above NA / index 0.6.
    model_error: standard deviation of the model relative to the light in a pixel; keeps
    bright pixels from ruling the fit.
    mask: file (NPY, TIFF) of a known phase in the pupil, rad, on a square about the
    aperture's circle, rows along +y; the fitted phase adds to it.
    mask_turn_deg: rotation of the mask from +x to +y.
    free: of numerical_aperture, index, pixel_um, step_um those that are known roughly
    and are fitted too.
    """

    numerical_aperture: float
    wavelength_um: float = field(default=math.nan, metadata={"above": 0})
    pixel_um: float = field(default=math.nan, metadata={"above": 0})
    index: float = 1.0
    step_um: float = field(default=math.nan, metadata={"signed": True})
    bead_um: float = 0.0
    window: int = field(default=40, metadata={"above": 7})
    center: tuple[int, int] | None = None
    phase_order: int = field(default=8, metadata={"above": 3})
    amplitude_order: int = 5
    drift_order: int = 3
    stage_sigma_um: float = math.nan
    model: Literal["auto", "vector", "scalar"] = "auto"
    model_error: float = 0.03
    mask: Path | None = None
    mask_turn_deg: float = field(default=0.0, metadata={"signed": True})
    free: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(set(self.free) & set(RELATIVE_PRIOR)) < len(self.free):
            raise FitError(
                f"free = {list(self.free)}: need some of {', '.join(RELATIVE_PRIOR)}, "
                "each once"
            )
        if not 0 < self.numerical_aperture < self.index:
            raise FitError(
                f"numerical_aperture = {self.numerical_aperture}: need above 0 and "
                f"below index {self.index}"
            )
        if self.step_um == 0:
            raise FitError("step_um = 0: need a length, either sign")
        if self.stage_sigma_um < 0 or math.isinf(self.stage_sigma_um):
            raise FitError(
                f"stage_sigma_um = {self.stage_sigma_um}: need a finite length of 0 or "
                "more"
            )

    @property
    def sine(self) -> float:
        """Sine of the half aperture angle."""
        return self.numerical_aperture / self.index

    @property
    def vectorial(self) -> bool:
        """Whether the vectorial Debye integral is used."""
        return self.model == "vector" or (self.model == "auto" and self.sine > 0.6)


class PupilModel:
    """Debye integral of an isotropic emitter (Richards and Wolf 1959), evaluated by
    matrix Fourier transforms.

    The pupil is exp(log-amplitude + i phase), both Zernike series. The intensity,
    summed over the dipole components, is convolved with bead, Gaussian blur and pixel.

    Accuracy: the pupil is sampled finely enough that images of ``window`` pixels do not
    wrap around at the farthest defocus; its rim is weighted by the covered share of a
    cell. Pixels of wavelength / 4 NA and less are sampled at their middle: their width
    is part of the blur, 0.29 of them, to 0.025 of the finest detail's contrast.

    Args:
        spec: optics, window and orders.
        position_um: (n,) stage positions about focus.
    """

    def __init__(self, spec: PupilSpec, position_um: Array) -> None:
        self.spec, self.position_um = spec, position_um
        self.phase_indices = zernike.zernike_indices(2, spec.phase_order)
        self.amplitude_indices = zernike.zernike_indices(1, spec.amplitude_order)
        span_um = max(float(np.abs(position_um).max()), 1e-9)
        self.drift_basis = np.polynomial.legendre.legvander(
            position_um / span_um, spec.drift_order
        ).T
        over = detector.fine_enough(
            spec.pixel_um, 2 * spec.numerical_aperture / spec.wavelength_um
        )
        self.grid = detector.DetectorGrid(
            spec.window, spec.window, spec.pixel_um, over, margin=3
        )

        defocus_um = 2 * span_um * spec.sine / math.sqrt(1 - spec.sine**2)
        period_um = (spec.window + 6) * spec.pixel_um + defocus_um
        room = (
            1.4 if spec.free else 1.1
        )  # factor that keeps images from wrapping around
        waves = period_um * spec.numerical_aperture / spec.wavelength_um
        self.nodes = 2 * math.ceil(room * waves / 2 + 6)
        self.axis = (2 * np.arange(self.nodes) + 1) / self.nodes - 1
        u, v = np.meshgrid(self.axis, self.axis)
        radius = np.hypot(u, v)
        covered = np.clip((1 - radius) * self.nodes / 2 + 0.5, 0, 1)
        self.inside = covered > 0
        self.covered = covered[self.inside]
        radius = np.maximum(radius[self.inside], 1)
        self.u, self.v = u[self.inside] / radius, v[self.inside] / radius
        self.phase_basis = zernike.zernike_basis(self.phase_indices, self.u, self.v)
        self.amplitude_basis = zernike.zernike_basis(
            self.amplitude_indices, self.u, self.v
        )
        turns = np.concatenate([1j * self.phase_basis, self.amplitude_basis])
        self._columns = self._on_square(turns.astype(np.complex64))
        self.mask: Array | float = 1.0
        if spec.mask is not None:
            self.mask = load_phase_mask(
                spec.mask, self.u, self.v, turn_rad=math.radians(spec.mask_turn_deg)
            )
        self.sizes = {name: len(group) for name, group in self.names().items()}
        last = np.cumsum(list(self.sizes.values())).tolist()
        self._places = {
            name: slice(end - size, end)
            for (name, size), end in zip(self.sizes.items(), last, strict=True)
        }

    @property
    def stage_sigma_um(self) -> float:
        """Standard deviation of the stage error of a plane."""
        if not math.isnan(self.spec.stage_sigma_um):
            return self.spec.stage_sigma_um
        return 0.1 * float(np.ptp(self.position_um)) / (len(self.position_um) - 1)

    def names(self) -> dict[str, list[str]]:
        """Names of the parameters with their units, by group, in the order of the
        parameter vector.
        """
        planes = range(len(self.position_um))
        degrees = range(self.spec.drift_order + 1)
        name = zernike.zernike_name
        return {
            "phase": [f"phase {name(i)} / rad" for i in self.phase_indices],
            "amplitude": [f"log-amplitude {name(i)}" for i in self.amplitude_indices],
            "drift_x": [f"drift x order {j} / um" for j in degrees],
            "drift_y": [f"drift y order {j} / um" for j in degrees],
            "stage": [f"stage {i} / um" for i in planes if self.stage_sigma_um > 0],
            "blur": ["blur / um"],
            "gain": [f"log-gain {i}" for i in planes],
            "background": [f"background {i} / e" for i in planes],
            "gradient": [f"background gradient {a} / e/pixel" for a in "xy"],
            "optics": [f"log {name} over stated" for name in self.spec.free],
        }

    def unpack(self, x: Array) -> dict[str, Array]:
        """Groups of a parameter vector, or of an array of its length, as views.

        Args:
            x: (p, ...) parameters in the order of :meth:`names`.
        """
        return {name: x[place] for name, place in self._places.items()}

    def optics_at(self, x: Array) -> tuple[PupilSpec, Array]:
        """Specification and (n,) stage positions in um with the fitted optics.

        A free quantity is its stated value times exp(parameter). The numerical aperture
        is kept below 0.98 of the index.

        Args:
            x: (p,) parameters in the order of :meth:`names`.
        """
        spec = self.spec
        if not spec.free:
            return spec, self.position_um
        logs = self.unpack(x)["optics"]
        factor = dict(zip(spec.free, np.exp(logs).tolist(), strict=True))
        position_um = self.position_um * factor.pop("step_um", 1.0)
        values = {name: getattr(spec, name) * size for name, size in factor.items()}
        index = max(values.get("index", spec.index), 1.0)
        aperture = values.get("numerical_aperture", spec.numerical_aperture)
        kind: Literal["vector", "scalar"] = "vector" if spec.vectorial else "scalar"
        values |= {"numerical_aperture": min(aperture, 0.98 * index), "index": index}
        return replace(spec, model=kind, **values), position_um

    def background(self, x: Array) -> Array:
        """(n, window, window) background in electrons: a level for each plane plus one
        linear gradient.

        Args:
            x: (p,) parameters in the order of :meth:`names`.
        """
        parts = self.unpack(x)
        offset = self._along()
        slope_x, slope_y = parts["gradient"]
        level = parts["background"][:, None, None]
        return np.asarray(level + slope_x * offset + slope_y * offset[:, None])

    def images(self, x: Array, jacobian: bool) -> tuple[Array, Array | None]:
        """Expected images (n, window, window) in electrons, and with ``jacobian`` their
        derivatives (p, n, window, window) by the parameters.

        An image is gain * sum over dipoles of |F(A exp(i phase))|², convolved with
        bead, blur and pixel, plus background. Its derivative by a pupil coefficient is
        2 Re(E* dE), in single precision. Derivatives by the optics are central
        differences.

        Args:
            x: (p,) parameters in the order of :meth:`names`.
            jacobian: whether derivatives are computed; None without it.
        """
        parts = self.unpack(x)
        spec, position_um = self.optics_at(x)
        wavenumber = 2 * math.pi * spec.index / spec.wavelength_um
        cosine_x, cosine_y = spec.sine * self.u, spec.sine * self.v
        cosine_z = np.sqrt(1 - cosine_x**2 - cosine_y**2)
        # dipole amplitudes (components, rays) at the direction cosines of the pupil
        dipoles = self.covered * dipole_components(
            cosine_x, cosine_y, vectorial=spec.vectorial
        )
        grid = replace(self.grid, pixel_um=spec.pixel_um)
        blur_um = parts["blur"][0]
        y_um, x_um = grid.axes_um()
        kernel_y = np.exp(1j * wavenumber * spec.sine * np.outer(y_um, self.axis))
        kernel_x = np.exp(1j * wavenumber * spec.sine * np.outer(self.axis, x_um))
        transfer, by_blur = self._transfer(grid, float(blur_um))

        z_um = position_um + (parts["stage"] if self.sizes["stage"] else 0.0)
        drift_x_um = parts["drift_x"] @ self.drift_basis
        drift_y_um = parts["drift_y"] @ self.drift_basis
        aberration_rad = parts["phase"] @ self.phase_basis
        phase_rad = aberration_rad + wavenumber * np.outer(z_um, cosine_z)
        phase_rad -= wavenumber * np.outer(drift_x_um, cosine_x)
        phase_rad -= wavenumber * np.outer(drift_y_um, cosine_y)
        amplitude = dipoles * np.exp(parts["amplitude"] @ self.amplitude_basis)
        pupil = self._on_square(
            (self.mask * np.exp(1j * phase_rad))[:, None] * amplitude
        )
        field = self._transform(pupil, kernel_y, kernel_x)
        intensity = (field.real**2 + field.imag**2).sum(1)

        pixel_step = 2 * spec.numerical_aperture * spec.pixel_um / spec.wavelength_um
        scale = np.exp(parts["gain"]) * (pixel_step / self.nodes) ** 2
        scale = (scale / (dipoles**2).sum())[:, None, None]

        light = scale * grid.sample(intensity, transfer)
        images = light + self.background(x)
        if not jacobian:
            return images, None

        derivatives = np.zeros((len(x), *images.shape))
        groups = self.unpack(derivatives)
        planes = np.arange(len(images))
        has_stage = bool(self.sizes["stage"])
        cosines = np.stack([-cosine_x, -cosine_y, cosine_z])[: 2 + has_stage]
        shift_columns = 1j * wavenumber * cosines
        columns = np.concatenate(
            [self._columns, self._on_square(shift_columns.astype(np.complex64))]
        )
        slopes = np.empty((len(columns), *images.shape), np.float32)
        pupil, field, kernel_y, kernel_x = (
            a.astype(np.complex64) for a in (pupil, field, kernel_y, kernel_x)
        )
        # 2 Re(E* dE) by every pupil coefficient and shift, a block of them at a time
        block = max(1, _BLOCK // field.size)
        for first in range(0, len(columns), block):
            changed = pupil * columns[first : first + block, None, None]
            change = self._transform(changed, kernel_y, kernel_x)
            products = field.view(np.float32) * change.view(np.float32)
            slope = 2 * (products[..., ::2] + products[..., 1::2]).sum(2)
            slopes[first : first + block] = grid.sample(slope, transfer)
        count = len(self._columns)
        drift = self.drift_basis[:, :, None, None] * scale
        np.multiply(slopes[:count], scale, out=derivatives[:count])
        np.multiply(drift, slopes[count], out=groups["drift_x"])
        np.multiply(drift, slopes[count + 1], out=groups["drift_y"])
        if has_stage:
            groups["stage"][planes, planes] = scale * slopes[-1]
        groups["blur"][:] = scale * grid.sample(intensity, by_blur)
        groups["gain"][planes, planes] = light
        groups["background"][planes, planes] = 1.0
        groups["gradient"][0] = self._along()
        groups["gradient"][1] = self._along()[:, None]
        step = 1e-4
        count = len(self.spec.free)
        for row, direction in zip(
            groups["optics"], np.eye(len(x))[len(x) - count :], strict=True
        ):
            above, below = (
                self.images(x + signed_step * direction, False)[0]
                for signed_step in (step, -step)
            )
            row[:] = (above - below) / (2 * step)
        return images, derivatives

    def pupil_maps(self, x: Array) -> tuple[Array, Array]:
        """Phase in rad (nan outside the pupil) and amplitude (0 outside) of parameters
        ``x``, (p,): (nodes, nodes) each.
        """
        parts = self.unpack(x)
        phase = np.full((self.nodes, self.nodes), np.nan)
        phase[self.inside] = parts["phase"] @ self.phase_basis
        return phase, self._on_square(np.exp(parts["amplitude"] @ self.amplitude_basis))

    def _along(self) -> Array:
        """(window,) pixel offsets from the middle pixel of the window."""
        return np.arange(self.spec.window) - self.spec.window // 2

    def _transfer(
        self, grid: detector.DetectorGrid, blur_um: float
    ) -> tuple[Array, Array]:
        """Transfer function of bead, Gaussian blur and pixel, and its derivative by the
        blur.
        """
        fy, fx = grid.frequencies()
        constant = detector.ball_transfer(fy, fx, self.spec.bead_um)
        if grid.oversample > 1:
            constant = constant * detector.pixel_transfer(fy, fx, grid.pixel_um)
        blur, slope = detector.gaussian_transfer(fy, fx, blur_um)
        return constant * blur, constant * slope

    def _transform(self, pupil: Array, kernel_y: Array, kernel_x: Array) -> Array:
        """(..., y, x) field of a (..., nodes, nodes) pupil by matrix Fourier
        transforms: kernel_y pupil kernel_x.
        """
        rows = pupil.reshape(-1, self.nodes) @ kernel_x
        return np.asarray(kernel_y @ rows.reshape(*pupil.shape[:-1], -1))

    def _on_square(self, values: Array) -> Array:
        """(..., nodes, nodes) array of (..., inside) values, 0 outside the pupil."""
        square = np.zeros((*values.shape[:-1], self.nodes, self.nodes), values.dtype)
        square[..., self.inside] = values
        return square


def dipole_components(x: Array, y: Array, *, vectorial: bool) -> Array:
    """Image-plane amplitudes of dipoles along x, y and z behind an aplanatic lens
    (Richards and Wolf 1959).

    Args:
        x: (rays,) direction cosines.
        y: (rays,) direction cosines.
        vectorial: False gives the scalar amplitude 1 / sqrt(cos theta) alone.

    Returns:
        (5, rays) or (1, rays); two of the six products of dipole and polarisation are
        equal and enter as one of sqrt(2) times the size.
    """
    sine2 = x**2 + y**2
    cosine = np.sqrt(1 - sine2)
    if not vectorial:
        return np.asarray(cosine**-0.5)[None]
    sine = np.sqrt(sine2)
    azimuth = np.arctan2(y, x)
    cosine_a = np.cos(azimuth)
    sine_a = np.sin(azimuth)
    rows = [
        1 + (cosine - 1) * cosine_a**2,
        math.sqrt(2) * (cosine - 1) * sine_a * cosine_a,
        -sine * cosine_a,
        1 + (cosine - 1) * sine_a**2,
        -sine * sine_a,
    ]
    return np.asarray(np.stack(rows) / np.sqrt(cosine))


def load_phase_mask(path: Path, u: Array, v: Array, *, turn_rad: float = 0.0) -> Array:
    """(*shape) exp(i phase) of a phase mask at points of the pupil.

    The complex number is interpolated bilinearly and divided by its modulus, so that
    jumps of 2 pi in the phase do no harm.

    Args:
        path: NPY or TIFF, a square phase map in rad about the pupil.
        u: (*shape) x in the pupil over its radius.
        v: (*shape) y in the pupil over its radius.
        turn_rad: rotation of the mask from +x to +y, rad.

    Raises:
        CaptureError: no square array of 8 finite numbers or more a side.
    """
    try:
        phase = (
            np.load(path, allow_pickle=False)
            if path.suffix == ".npy"
            else np.asarray(read_images(path)[0])
        )
    except (OSError, ValueError, EOFError) as error:
        raise CaptureError(f"{path}: no mask can be read: {error}") from error
    side = len(phase) if phase.ndim == 2 else 0
    if side < 8 or phase.shape != (side, side) or not np.isfinite(phase).all():
        raise CaptureError(
            f"{path}: a mask of {phase.shape} {phase.dtype}; need a square of 8 finite "
            "numbers or more"
        )
    cosine = math.cos(turn_rad)
    sine = math.sin(turn_rad)
    indices = [
        (coordinate + 1) * side / 2 - 0.5
        for coordinate in (cosine * v - sine * u, cosine * u + sine * v)
    ]
    mask = np.exp(1j * phase.astype(float))
    samples = ndimage.map_coordinates(mask, indices, order=1, mode="nearest")
    return np.asarray(samples / np.maximum(np.abs(samples), 1e-9))
