"""The PSF stack as a record and as a file."""

import dataclasses
import functools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.notebook import RecordView, own_axes
from metalens.core.store import Provenance, typed_reader
from metalens.propagate import axis_positions
from metalens.psf.budget import PsfErrorBudget

SourceShape = Literal["disc", "square", "gaussian"]
NO_BUDGET = PsfErrorBudget(math.nan)  # its error stands for it


@functools.lru_cache(maxsize=1)
def _made_here() -> Provenance:
    """Provenance of a stack made in this process; package versions are looked up once."""
    return Provenance()


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class PsfStack(RecordView):
    """Point spread functions over depth, field angle and lens.

    Attributes:
        intensity: (…, [angle,] depth, y, x) PSFs, the sum over (y, x) is 1; numpy or
            torch, as the lens came in. Axes before the angle are a batch of lenses.
        energy_um2: (…, [angle,] depth) power in the window for unit irradiance of the
            lens: Σ |U|² step².
        depths_um: (depth,) of the source from the lens, inf for a plane wave.
        angles_rad: (angle, 2) field angles (x, y).
        wavelengths_um: (wavelength,) whose irradiances are added.
        weights: (wavelength,) of that sum, together 1.
        step_um: distance of neighbouring samples.
        centres_um: (angle, 2) window centres (x, y) on the sensor.
        sensor_distance_um: from the lens to the sensor.
        tolerance: relative L2 error that was asked for.
        error: estimated relative L2 error of the intensity, the worst over angles and
            lenses: of what is computed, and for a fitted lens of its posterior.
        reason: method, and why it stopped.
        provenance: settings and input files.
        budget: the error by cause, with what the model leaves out; where none is given,
            the error is numerical.
    """

    intensity: Any
    energy_um2: Any
    depths_um: Array
    angles_rad: Array
    wavelengths_um: Array
    weights: Array
    step_um: float
    centres_um: Array
    sensor_distance_um: float
    tolerance: float
    error: float
    reason: str
    provenance: Provenance = field(default_factory=_made_here)
    budget: PsfErrorBudget = NO_BUDGET

    def __post_init__(self) -> None:
        if math.isnan(self.budget.numerical):
            object.__setattr__(self, "budget", PsfErrorBudget(self.error))

    @property
    def irradiance_per_um2(self) -> Array:
        """(angle, depth) irradiance on the lens plane from a point source of intensity
        1 per steradian: cos³θ / z².

        ``energy_um2`` times it is the power in the window: energies of angles and
        depths then compare. 0 at infinity.
        """
        steep = 1 + (np.tan(np.asarray(self.angles_rad)) ** 2).sum(-1, keepdims=True)
        return np.asarray(steep**-1.5 / np.asarray(self.depths_um) ** 2)

    @property
    def x_um(self) -> Array:
        """(x,) positions from the window centre."""
        return axis_positions(self.intensity.shape[-1], self.step_um)

    @property
    def y_um(self) -> Array:
        """(y,) positions from the window centre."""
        return axis_positions(self.intensity.shape[-2], self.step_um)

    @property
    def converged(self) -> bool:
        """Whether the error of what is computed is within the tolerance."""
        fit = self.budget.posterior
        return (
            math.sqrt(max(self.error**2 - np.nan_to_num(fit) ** 2, 0)) <= self.tolerance
        )

    def plot(self, ax: Any = None, *, depth: int = 0) -> Any:
        """Draw the square root of a PSF of the first direction; returns the axes.

        Args:
            ax: matplotlib axes; those of a new figure where none are given.
            depth: its number.
        """
        axes = own_axes(ax)
        x, y = self.x_um, self.y_um
        psfs = self.numpy().intensity.reshape(-1, len(y), len(x))
        root = np.sqrt(psfs[depth].clip(0))
        axes.imshow(root, extent=(x[0], x[-1], y[-1], y[0]))
        axes.set(title="√PSF", xlabel="x / µm", ylabel="y / µm")
        return axes

    def to_xarray(self) -> Any:
        """xarray.Dataset of intensity and energy over (angle, depth_um, y_um, x_um)."""
        import xarray

        plain = self.numpy()
        shape = len(self.angles_rad), len(self.depths_um)
        names = ("angle", "depth_um", "y_um", "x_um")
        x, y = self.x_um, self.y_um
        light = plain.intensity.reshape(*shape, len(y), len(x))
        return xarray.Dataset(
            {
                "intensity": (names, light),
                "energy_um2": (names[:2], plain.energy_um2.reshape(shape)),
            },
            {
                "depth_um": self.depths_um,
                "y_um": y,
                "x_um": x,
                "angle_x_rad": (("angle",), self.angles_rad[:, 0]),
                "angle_y_rad": (("angle",), self.angles_rad[:, 1]),
            },
            {"relative_error": self.error, "wavelengths_um": self.wavelengths_um},
        )

    def numpy(self) -> "PsfStack":
        """The same record with numpy arrays, detached from any graph."""
        if isinstance(self.intensity, np.ndarray):
            return self
        light, energy = (
            values.detach().cpu().numpy()
            for values in (self.intensity, self.energy_um2)
        )
        return dataclasses.replace(self, intensity=light, energy_um2=energy)


AXES = ("depths_um", "angles_rad", "wavelengths_um", "weights", "centres_um")
NUMBERS = ("step_um", "sensor_distance_um", "tolerance", "error", "reason")


def save(path: str | Path, stack: PsfStack) -> None:
    """Write a PSF file (kind ``psf``).

    Args:
        path: file to write.
        stack: PSFs over angle, depth and wavelength.
    """
    plain = stack.numpy()
    arrays = {
        name: np.asarray(getattr(plain, name))
        for name in ("intensity", "energy_um2", *AXES)
    }
    about = {name: getattr(plain, name) for name in NUMBERS}
    about |= {
        f"budget_{name}": value
        for name, value in dataclasses.asdict(plain.budget).items()
    }
    store.save(path, "psf", arrays, attributes=about, provenance=stack.provenance)


@typed_reader
def load(path: str | Path) -> PsfStack:
    """Read a PSF file.

    Args:
        path: file to read.

    Raises:
        StoreError: missing, truncated, or not a PSF file.
    """
    stored = store.load(path, "psf")
    fields: dict[str, Any] = {
        name: stored.attributes[name] for name in NUMBERS
    } | stored.arrays
    terms = {
        f.name: stored.attributes.get(f"budget_{f.name}")
        for f in dataclasses.fields(PsfErrorBudget)
    }
    budget = PsfErrorBudget(**{n: float(v) for n, v in terms.items() if v is not None})
    return PsfStack(**fields, provenance=stored.provenance, budget=budget)
