"""A generic pupil: through-focus images of a small bead by any objective, from NA,
wavelength and pixel alone.
"""

import math
from dataclasses import dataclass, field
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
FREE = {
    "numerical_aperture": 0.1,
    "index": 0.03,
    "pixel_um": 0.1,
    "step_um": 0.1,
}  # usual relative errors
_STAGE = 0.1  # of the step, by which planes stand off where nobody says
_SHARP = 0.01  # pixels of blur that are none: 5e-4 of the finest detail


@dataclass(frozen=True, slots=True)
class PupilSpec:
    """What is known of the microscope or lens; TOML of ``metalens fit --pupil``.

    numerical_aperture: on the object side, below ``index``.
    wavelength_um: in vacuum, of the light; pixel_um: in object space (sensor pixel over
    magnification).
    index: of the medium between bead and lens.
    step_um: stage step, used where the capture has no positions.
    bead_um: diameter of an evenly glowing bead (0: a point).
    window: pixels of the square that is fitted, centred on the bead; center: its (row,
    column), else found.
    phase_order, amplitude_order: highest radial Zernike order of phase and of
    log-amplitude.
    drift_order: of the polynomial sideways drift through the stack.
    stage_sigma_um: by which single planes stand off their stated positions, standard
    deviation: a tenth of the step
        without it, 0 for a stage that is believed.
    model: vector or scalar; auto takes vector above NA / index 0.6.
    model_error: share of the light that no model of this kind explains; keeps bright
    pixels from ruling the fit.
    mask: file (NPY, TIFF) of a known phase in the pupil, rad, on a square about the
    aperture's circle, rows along +y;
        the fitted phase is what comes on top. mask_turn_deg: by which it is turned,
        from +x to +y.
    free: of numerical_aperture, index, pixel_um, step_um those that are known roughly
    and are fitted too.
    """

    numerical_aperture: float
    wavelength_um: float = field(default=math.nan, metadata={"above": 0})
    pixel_um: float = field(default=math.nan, metadata={"above": 0})
    index: float = 1.0
    step_um: float = field(default=math.nan, metadata={"signed": True})
    bead_um: float = 0.0
    window: int = field(default=40, metadata={"above": 0})
    center: tuple[int, int] | None = None
    phase_order: int = 8
    amplitude_order: int = 5
    drift_order: int = 3
    stage_sigma_um: float = math.nan
    model: Literal["auto", "vector", "scalar"] = "auto"
    model_error: float = 0.03
    mask: Path | None = None
    mask_turn_deg: float = field(default=0.0, metadata={"signed": True})
    free: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.mask is not None and not self.mask.name:
            raise FitError(f"mask = {str(self.mask)!r}: need the name of a file")
        unknown = [name for name in self.free if name not in FREE]
        if unknown or len(set(self.free)) < len(self.free):
            raise FitError(
                f"free = {list(self.free)}: need some of {', '.join(FREE)}, each once"
            )
        if not 0 < self.numerical_aperture < self.index:
            raise FitError(
                f"numerical_aperture = {self.numerical_aperture}: need above 0 and below index {self.index}"
            )
        for key in ("wavelength_um", "pixel_um", "step_um"):
            if (
                not math.isnan(getattr(self, key))
                and not 0 < abs(getattr(self, key)) < math.inf
            ):
                raise FitError(
                    f"{key} = {getattr(self, key)}: need a finite length other than 0"
                )
        if self.stage_sigma_um < 0 or math.isinf(self.stage_sigma_um):
            raise FitError(
                f"stage_sigma_um = {self.stage_sigma_um}: need a finite length of 0 or more"
            )
        if (
            self.phase_order < 4
            or min(self.amplitude_order, self.drift_order) < 0
            or self.window < 8
        ):
            raise FitError(
                "need phase_order >= 4, amplitude_order >= 0, drift_order >= 0 and a window of 8 pixels or more"
            )

    @property
    def sine(self) -> float:
        """Sine of the half aperture angle."""
        return self.numerical_aperture / self.index

    @property
    def vectorial(self) -> bool:
        """Whether the six-component model is used."""
        return self.model == "vector" or (self.model == "auto" and self.sine > 0.6)


@dataclass(frozen=True, slots=True)
class ParameterLayout:
    """Which parameter is where: phase, log-amplitude, drift x and y, stage, blur, gain
    and background of each frame.

    stage: of frames whose stage error is a parameter, all or none.
    """

    phase: int
    amplitude: int
    drift: int
    frames: int
    stage: int

    @property
    def off(self) -> slice:
        """Of the stage errors."""
        first = self.phase + self.amplitude + 2 * self.drift
        return slice(first, first + self.stage)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return (
            self.phase
            + self.amplitude
            + 2 * self.drift
            + self.stage
            + 1
            + 2 * self.frames
        )

    def split(
        self, x: Array
    ) -> tuple[Array, Array, Array, Array, Array, float, Array, Array]:
        """The groups, in the order above; no stage errors are zeros."""
        sizes = [
            self.phase,
            self.amplitude,
            self.drift,
            self.drift,
            self.stage,
            1,
            self.frames,
            self.frames,
        ]
        phase, amplitude, dx, dy, dz, blur, gain, background = np.split(
            x, np.cumsum(sizes)[:-1]
        )
        return (
            phase,
            amplitude,
            dx,
            dy,
            dz if self.stage else np.zeros(self.frames),
            float(blur[0]),
            gain,
            background,
        )


class PupilModel:
    """Images of one bead at given stage positions as a function of the parameters of
    :class:`ParameterLayout`.

    Accuracy: the pupil is sampled finely enough that images of ``window`` pixels do not
    wrap around at the farthest
    defocus; the rim of the disc is weighted by the covered share of its cells. Pixels
    of wavelength / 4 NA and less are
    sampled at their middle: their width is part of the blur, 0.29 of them, to 0.025 of
    the finest detail's contrast.
    """

    def __init__(
        self,
        spec: PupilSpec,
        position_um: Array,
        *,
        phase_order: int,
        amplitude_order: int,
        nodes: int | None = None,
    ) -> None:
        _need(spec, position_um)
        self.spec, self.position_um = spec, position_um
        self.stage_sigma_um = stage_sigma_um(spec, position_um)
        self.span_um = max(float(np.abs(position_um).max()), 1e-9)
        highest = 2 * spec.numerical_aperture / spec.wavelength_um
        over = detector.fine_enough(spec.pixel_um, highest)
        self.grid = detector.DetectorGrid(
            spec.window, spec.window, spec.pixel_um, over, margin=3
        )
        self._sample_pupil(phase_order, amplitude_order, nodes)
        fy, fx = self.grid.frequencies()
        fixed = (
            detector.pixel_transfer(fy, fx, spec.pixel_um)
            if over > 1
            else np.ones_like(fy * fx)
        )
        self._fixed, self._f = (
            fixed * detector.ball_transfer(fy, fx, spec.bead_um),
            (fy, fx),
        )
        self._sharp = over == 1 and not spec.bead_um

    def _sample_pupil(
        self, phase_order: int, amplitude_order: int, nodes: int | None
    ) -> None:
        spec, k = self.spec, 2 * math.pi * self.spec.index / self.spec.wavelength_um
        sine, width = spec.sine, (spec.window + 6) * spec.pixel_um
        blur = 2 * self.span_um * sine / math.sqrt(1 - sine**2)
        nodes = nodes or 2 * math.ceil(
            sine * spec.index / spec.wavelength_um * (width + blur) * 0.55 + 6
        )
        q = (np.arange(nodes) - (nodes - 1) / 2) * (2 * sine / nodes)
        sx, sy = np.meshgrid(q, q)
        weight = np.clip((sine - np.hypot(sx, sy)) / (q[1] - q[0]) + 0.5, 0, 1)
        self.inside = weight > 0
        self.sx, self.sy = sx[self.inside], sy[self.inside]
        squeeze = np.minimum(1, sine / np.maximum(np.hypot(self.sx, self.sy), 1e-12))
        self.cosine = np.sqrt(1 - (self.sx * squeeze) ** 2 - (self.sy * squeeze) ** 2)
        self.k, self.nodes = k, nodes
        self.phase_indices = zernike.zernike_indices(2, phase_order)
        self.amplitude_indices = zernike.zernike_indices(1, amplitude_order)
        u, v = self.sx * squeeze / sine, self.sy * squeeze / sine
        self.phase_basis = zernike.zernike_basis(self.phase_indices, u, v)
        self.amplitude_basis = zernike.zernike_basis(self.amplitude_indices, u, v)
        self._mask = (
            1.0
            if spec.mask is None
            else phase_mask(spec.mask, u, v, turn_rad=math.radians(spec.mask_turn_deg))
        )
        ways = k * np.stack([-self.sx, -self.sy, self.cosine])
        turns = np.concatenate([1j * self.phase_basis, self.amplitude_basis, 1j * ways])
        self._columns = self._square(turns.astype(np.complex64))
        self.components = weight[self.inside] * _components(
            self.sx * squeeze, self.sy * squeeze, spec.vectorial
        )
        y, x = self.grid.axes_um()
        self._ey, self._ex = (
            np.exp(1j * k * y[:, None] * q),
            np.exp(1j * k * q[:, None] * x),
        )
        period = 2 * math.pi / (k * (q[1] - q[0]))
        self._norm = (self.grid.pixel_um / period) ** 2

    def layout(self) -> ParameterLayout:
        """Where each parameter is."""
        n = len(self.position_um)
        many = (
            len(self.phase_indices),
            len(self.amplitude_indices),
            self.spec.drift_order + 1,
        )
        return ParameterLayout(*many, n, n if self.stage_sigma_um > 0 else 0)

    def names(self) -> list[str]:
        """Name of every parameter, with its unit."""
        n, drift = len(self.position_um), range(self.spec.drift_order + 1)
        return [
            *(f"phase {zernike.zernike_name(i)} / rad" for i in self.phase_indices),
            *(
                f"log-amplitude {zernike.zernike_name(i)}"
                for i in self.amplitude_indices
            ),
            *(f"drift {axis} order {j} / um" for axis in "xy" for j in drift),
            *(f"stage {i} / um" for i in range(self.layout().stage)),
            "blur / um",
            *(f"log-gain {i}" for i in range(n)),
            *(f"background {i} / e" for i in range(n)),
        ]

    def images(self, x: Array, jacobian: bool) -> tuple[Array, Array | None]:
        """Expected images (n, window, window) in electrons, and their derivatives by
        every parameter.
        """
        layout = self.layout()
        phase, amplitude, dx, dy, dz, blur, gain, background = layout.split(x)
        envelope = self.components * np.exp(amplitude @ self.amplitude_basis)
        total = (envelope**2).sum()
        scale = (np.exp(gain) * self._norm / total)[:, None, None]
        pupil = self._square(self._pupils(phase, dx, dy, dz)[:, None] * envelope)
        sharp = self._sharp and blur <= _SHARP * self.spec.pixel_um
        field = self._transform(pupil, sharp)
        intensity = (field.real**2 + field.imag**2).sum(1)
        transfer = (
            None
            if sharp
            else self._fixed * detector.gaussian_transfer(*self._f, blur)[0]
        )
        light = self._seen(intensity, transfer) * scale
        image = light + background[:, None, None]
        if not jacobian:
            return image, None
        out = np.zeros((layout.size, *image.shape))
        self._pupil_columns(
            out,
            layout,
            (pupil.astype(np.complex64), field.astype(np.complex64)),
            transfer,
        )
        out[: layout.size - 2 * layout.frames - 1] *= scale
        for j, z in enumerate(self.amplitude_basis, layout.phase):
            out[j] -= light * (2 * (envelope**2 * z).sum() / total)
        by_blur = (
            None
            if sharp
            else self._fixed * detector.gaussian_transfer(*self._f, blur)[1]
        )
        self._linear_columns(
            out,
            layout,
            light,
            0 * light if sharp else self._seen(intensity, by_blur) * scale,
        )
        return image, out

    def _seen(self, intensity: Array, transfer: Array | None) -> Array:
        """Intensity (..., y, x) through bead, blur and pixels; as it is, one sample a
        pixel, without a transfer.
        """
        return intensity if transfer is None else self.grid.sample(intensity, transfer)

    def _pupil_columns(
        self,
        out: Array,
        layout: ParameterLayout,
        at: tuple[Array, Array],
        transfer: Array | None,
    ) -> None:
        """Derivatives by phase, log-amplitude and drift, before the scale: 2 Re E* dE,
        many at a time.
        """
        pupil, field = at
        first, drift = layout.phase + layout.amplitude, self._legendre()
        block = max(1, _BLOCK // field.size)
        last = first + 2 + bool(layout.stage)
        for start in range(0, last, block):
            some = slice(start, min(start + block, last))
            change = self._transform(
                pupil * self._columns[some, None, None], transfer is None
            )
            both = field.view(np.float32) * change.view(np.float32)
            slope = 2 * (both[..., ::2] + both[..., 1::2]).sum(2)
            for j, seen in zip(
                range(some.start, some.stop), self._seen(slope, transfer), strict=True
            ):
                if j < first:
                    out[j] = seen
                elif j == first + 2:  # every plane by itself along the axis
                    out[layout.off][
                        np.arange(layout.stage), np.arange(layout.stage)
                    ] = seen
                else:  # tilt along x or y, times each polynomial along the stack
                    place = first + (j - first) * layout.drift
                    out[place : place + layout.drift] = drift[:, :, None, None] * seen

    def _linear_columns(
        self, out: Array, layout: ParameterLayout, light: Array, blur_slope: Array
    ) -> None:
        first = layout.size - 2 * layout.frames
        out[first - 1] = blur_slope
        for i in range(layout.frames):
            out[first + i, i] = light[i]
            out[first + layout.frames + i, i] = 1

    def _pupils(self, phase: Array, dx: Array, dy: Array, dz: Array) -> Array:
        """(n, inside) phase factors of every frame: aberration, defocus, sideways
        drift.
        """
        drift = self._legendre()
        angle = (phase @ self.phase_basis)[None] + self.k * (self.position_um + dz)[
            :, None
        ] * self.cosine
        angle = angle - self.k * (
            (dx @ drift)[:, None] * self.sx + (dy @ drift)[:, None] * self.sy
        )
        return np.asarray(np.exp(1j * angle) * self._mask)

    def _legendre(self) -> Array:
        """(drift order + 1, n) Legendre polynomials along the stack."""
        return np.asarray(
            np.polynomial.legendre.legvander(
                self.position_um / self.span_um, self.spec.drift_order
            ).T
        )

    def _transform(self, pupil: Array, sharp: bool) -> Array:
        """(..., nodes, nodes) -> (..., y, x) field on the fine grid; without its margin
        where nothing blurs.
        """
        inner = slice(self.grid.margin, -self.grid.margin) if sharp else slice(None)
        ey, ex = (
            way.astype(pupil.dtype) for way in (self._ey[inner], self._ex[:, inner])
        )
        rows = pupil.reshape(-1, self.nodes) @ ex
        return np.asarray(ey @ rows.reshape(*pupil.shape[:-1], -1))

    def _square(self, values: Array) -> Array:
        """(..., inside) -> (..., nodes, nodes), 0 outside the aperture."""
        square = np.zeros((*values.shape[:-1], self.nodes, self.nodes), values.dtype)
        square[..., self.inside] = values
        return square


def _components(sx: Array, sy: Array, vectorial: bool) -> Array:
    """(5 or 1, inside) amplitudes in the image of dipoles along x, y and z, with the
    aplanatic 1/sqrt(cos).

    Two of the six are equal, and are one of sqrt(2) times the size.
    """
    sine2 = sx**2 + sy**2
    cosine = np.sqrt(1 - sine2)
    if not vectorial:
        return np.asarray(1 / np.sqrt(cosine))[None]
    angle = np.arctan2(sy, sx)
    c, s, lower = np.cos(angle), np.sin(angle), cosine - 1
    rows = [
        1 + lower * c * c,
        math.sqrt(2) * lower * s * c,
        -np.sqrt(sine2) * c,
        1 + lower * s * s,
        -np.sqrt(sine2) * s,
    ]
    return np.asarray(np.stack(rows) / np.sqrt(cosine))


def phase_mask(path: Path, u: Array, v: Array, *, turn_rad: float = 0.0) -> Array:
    """exp(i phase) of a mask in a file at pupil places (u, v) over the aperture's
    radius.

    Linear between the file's pixels, of the complex number: jumps by 2 pi are none.

    Args:
        path: image of the mask.
        turn_rad: by which the mask is turned, rad.

    Raises:
        CaptureError: no square picture of finite numbers.
    """
    try:
        phase = (
            np.load(path, allow_pickle=False)
            if path.suffix == ".npy"
            else np.asarray(read_images(path)[0])
        )
    except (OSError, ValueError, EOFError) as error:
        raise CaptureError(f"{path}: no mask can be read: {error}") from error
    n = len(phase) if phase.ndim == 2 else 0
    if (
        n < 8
        or phase.shape != (n, n)
        or phase.dtype.kind not in "fiu"
        or not np.isfinite(phase).all()
    ):
        raise CaptureError(
            f"{path}: a mask of {phase.shape} {phase.dtype}; need a square of 8 finite numbers or more"
        )
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    place = [(one + 1) * n / 2 - 0.5 for one in (c * v - s * u, c * u + s * v)]
    turns = np.exp(1j * phase.astype(float))
    parts = [
        ndimage.map_coordinates(part, place, order=1, mode="nearest")
        for part in (turns.real, turns.imag)
    ]
    found = parts[0] + 1j * parts[1]
    return np.asarray(found / np.maximum(np.abs(found), 1e-9))


def stage_sigma_um(spec: PupilSpec, position_um: Array) -> float:
    """By which single planes of a whole stack stand off: as stated, else a tenth of the
    mean step.

    Args:
        spec: what is known of optics and stage.
        position_um: (n,) stated positions, um.
    """
    if not math.isnan(spec.stage_sigma_um):
        return spec.stage_sigma_um
    return _STAGE * float(np.ptp(position_um)) / max(len(position_um) - 1, 1)


def _need(spec: PupilSpec, position_um: Array) -> None:
    for key, text in (
        ("wavelength_um", "the light's wavelength"),
        ("pixel_um", "the pixel in object space"),
    ):
        if math.isnan(getattr(spec, key)):
            raise CaptureError(
                f"{key} is missing: give {text} in the pupil file or in capture.toml; it cannot be fitted"
            )
    if not np.isfinite(position_um).all():
        raise CaptureError(
            "stage positions are missing: give step_um in the pupil file, or a stage.csv"
        )
