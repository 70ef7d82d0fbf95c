"""The process: what the writer and the etch can do, read from PROCESS.toml."""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from metalens.core import config
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, ProcessError
from metalens.core.units import deg
from metalens.fabrication import Bias, Spread, with_table

LayerNumber = tuple[int, int]  # layer, datatype


@dataclass(frozen=True)
class DesignRules:
    """What can be printed, and on which grid.

    minimum_feature_nm, minimum_gap_nm: thinnest pillar and narrowest gap, of the
    written polygons.
    minimum_foot_gap_nm: narrowest gap at the foot of the pillars as they come out of
    the etch, with tilted walls.
    grid_nm: step of all mask coordinates (whole nm).
    diameter_step_nm: step of the diameters, a multiple of the grid: one class of
    pillars each.
    angle_step_deg: step of the turns of pillars that are turned one by one, a divisor
    of 180: one class each.
    vertices: of a pillar polygon, 8 to 64, a multiple of 4; 8: only horizontal,
    vertical and diagonal edges.
    maximum_density, density_window_um: share of the area that pillars may cover in any
    window of that size.
    """

    minimum_feature_nm: float = 80.0
    minimum_gap_nm: float = 70.0
    minimum_foot_gap_nm: float = 50.0
    grid_nm: int = 1
    diameter_step_nm: int = 2
    angle_step_deg: float = 1.0
    vertices: int = 32
    maximum_density: float = 0.75
    density_window_um: float = 20.0

    def __post_init__(self) -> None:
        """Refuse values out of range, and steps that do not divide each other."""
        check_positive(
            self,
            "minimum_feature_nm",
            "minimum_gap_nm",
            "grid_nm",
            "diameter_step_nm",
            "density_window_um",
            "angle_step_deg",
        )
        if self.diameter_step_nm % self.grid_nm:
            raise ProcessError(
                f"a grid of {self.grid_nm} nm is coarser than, or no divisor of, diameter_step_nm = "
                f"{self.diameter_step_nm}; make the step a multiple of the grid"
            )
        if abs(180 / self.angle_step_deg - round(180 / self.angle_step_deg)) > 1e-9:
            raise ProcessError(
                f"angle_step_deg = {self.angle_step_deg}: need a divisor of 180, as 1, 2.5 or 15"
            )
        if not 8 <= self.vertices <= 64 or self.vertices % 4:
            raise ProcessError(
                f"vertices = {self.vertices}: need a multiple of 4 from 8 to 64"
            )
        if not 0 < self.maximum_density <= 1:
            raise ProcessError(
                f"maximum_density = {self.maximum_density}: need a share above 0 and at most 1"
            )


@dataclass(frozen=True)
class LayerTable:
    """(layer, datatype) of each kind of shape; ``dose`` holds the dose-test array.

    pillar, aperture, marks, labels, dose, witness, fields, outline: (layer, datatype)
    of these shapes.
    """

    pillar: LayerNumber = (1, 0)
    aperture: LayerNumber = (2, 0)
    marks: LayerNumber = (3, 0)
    labels: LayerNumber = (4, 0)
    dose: LayerNumber = (5, 0)
    witness: LayerNumber = (6, 0)
    fields: LayerNumber = (7, 0)
    outline: LayerNumber = (10, 0)

    def __post_init__(self) -> None:
        """Refuse numbers beyond 16 bits, and layer numbers used twice: their datatypes
        are doses.
        """
        name_of_layer: dict[int, str] = {}
        for entry in dataclasses.fields(self):
            number = getattr(self, entry.name)
            if not all(0 <= n <= 65535 for n in number):
                raise ProcessError(
                    f"layer {entry.name} = {list(number)}: need numbers from 0 to 65535"
                )
            other = name_of_layer.setdefault(number[0], entry.name)
            if other != entry.name:
                raise ProcessError(
                    f"layers {other} and {entry.name} are both on number {number[0]}, "
                    "whose datatypes are doses; give each its own number"
                )


@dataclass(frozen=True)
class EtchProfile:
    """Shape of the fabricated structure.

    sidewall_deg: tilt of the wall from the vertical, above 0 where the foot is wider
    than the top.
    corner_radius_nm: radius to which convex corners of the drawn shape round off.
    """

    sidewall_deg: float = 0.0
    corner_radius_nm: float = 10.0

    def __post_init__(self) -> None:
        if not abs(self.sidewall_deg) < 45:
            raise ProcessError(
                f"sidewall_deg = {self.sidewall_deg}: need an angle within +-45"
            )


@dataclass(frozen=True)
class ExposureSettings:
    """Electron exposure: base dose, point-exposure function, dose classes.

    base_uC_cm2: dose that just clears the edge of a wide, uniformly written area.
    alpha_um, beta_um, eta: double Gaussian of the point exposure (forward range,
    backscatter range, ratio of
        the two energies), as measured for your resist, film and voltage: there is no
        default.
    gamma_um, nu: a third Gaussian between them (range, ratio of its energy to the
    forward one), where you have it.
    csv: a measured radial point-exposure function instead (radius in um, energy density
    in any unit).
    tolerance: largest relative exposure error at a pillar's edge that the dose classes
    may leave.
    maximum_classes: how many doses the writer can hold in one job, at most 255; no more
    than the tolerance needs are
        used.
    correct: whether the mask carries corrected doses (a datatype each) or a single one;
    left out: where a point
        exposure is given.
    """

    base_uC_cm2: float = 300.0
    alpha_um: float | None = None
    beta_um: float | None = None
    eta: float | None = None
    gamma_um: float | None = None
    nu: float = 0.0
    csv: Path | None = None
    tolerance: float = 0.01
    maximum_classes: int = 255
    correct: bool | None = None

    def __post_init__(self) -> None:
        """Refuse values out of range, and settings that contradict each other."""
        check_positive(self, "base_uC_cm2", "tolerance", "maximum_classes")
        check_positive(self, "alpha_um", "beta_um", "gamma_um")
        if (
            self.beta_um is not None
            and self.alpha_um is not None
            and self.beta_um <= self.alpha_um
        ):
            raise ProcessError(
                f"beta_um = {self.beta_um} must exceed alpha_um = {self.alpha_um}"
            )
        if (self.gamma_um is None) != (self.nu == 0):
            raise ProcessError(
                f"gamma_um = {self.gamma_um} and nu = {self.nu}: a third Gaussian needs both"
            )
        if self.maximum_classes > 255:
            raise ProcessError(
                f"maximum_classes = {self.maximum_classes}: need at most 255"
            )
        if self.correct and not self.known:
            raise ProcessError(
                f"exposure.correct = true needs {self.missing}; measure them, or leave correct out"
            )

    @property
    def known(self) -> bool:
        """Whether a point exposure is given."""
        return self.csv is not None or None not in (
            self.alpha_um,
            self.beta_um,
            self.eta,
        )

    @property
    def missing(self) -> str:
        """Names of what a point exposure still needs."""
        return (
            ", ".join(
                n for n in ("alpha_um", "beta_um", "eta") if getattr(self, n) is None
            )
            + " (or csv)"
        )

    @property
    def corrected(self) -> bool:
        """Whether the mask is to carry corrected doses."""
        return self.known if self.correct is None else self.correct


@dataclass(frozen=True)
class WriteField:
    """Write fields of the e-beam tool.

    size_um: largest side of a field.
    mode: ``shift``: equal fields on a fixed raster that is shifted between the pillars;
    ``floating``: each border
        lies where it is best, fields are as few and as equal as possible.
    stitching_nm: how far two fields may be misplaced (largest error along x and y).
    """

    size_um: float = 500.0
    mode: Literal["shift", "floating"] = "floating"
    stitching_nm: float = 20.0

    def __post_init__(self) -> None:
        check_positive(self, "size_um")


@dataclass(frozen=True)
class DieSettings:
    """The die around the aperture.

    size_um: (x, y) of the die; left out: the aperture and ``margin_um`` on each side.
    street_um: strip along the edge that stays empty.
    mark_um, mark_width_um: length and line width of the alignment crosses; fine ones
    beside them have a fifth of both.
    verniers: whether verniers and a box in a box show how far pillars and aperture lie
    apart.
    vernier_pitch_um: from bar to bar of the scale that is drawn with the pillars.
    vernier_step_nm: by how much the pitch of the other scale, opened with the aperture,
    is longer: what a bar reads.
    label: text on the die; left out: from the lens.
    margin_um: around the aperture, where no size is given.
    """

    size_um: tuple[float, float] | None = None
    margin_um: float = 500.0
    street_um: float = 50.0
    mark_um: float = 100.0
    mark_width_um: float = 5.0
    verniers: bool = True
    vernier_pitch_um: float = 8.0
    vernier_step_nm: float = 50.0
    label: str = ""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_positive(
            self,
            "size_um",
            "margin_um",
            "mark_um",
            "mark_width_um",
            "vernier_pitch_um",
            "vernier_step_nm",
        )
        if self.vernier_pitch_um < 4:
            raise ProcessError(
                f"vernier_pitch_um = {self.vernier_pitch_um}: need 4 or more, for visible bars"
            )


@dataclass(frozen=True)
class Process:
    """A fabrication process.

    tone: ``positive``: the drawn shapes become pillars; ``negative``: the gaps between
    pillars are drawn.
    name: on report and job sheet. rules: what can be made. layers: where shapes are
    drawn. bias: fabricated less drawn size.
    etch: how widths change with the density around. exposure: spread of the dose.
    write_field: fields of the writer.
    die: what stands around the lens. spread: of the process, for ``--study`` and the
    error budget.
    """

    name: str = "e-beam, a-Si on fused silica"
    tone: Literal["positive", "negative"] = "positive"
    rules: DesignRules = field(default_factory=DesignRules)
    layers: LayerTable = field(default_factory=LayerTable)
    bias: Bias = field(default_factory=Bias)
    etch: EtchProfile = field(default_factory=EtchProfile)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    write_field: WriteField = field(default_factory=WriteField)
    die: DieSettings = field(default_factory=DieSettings)
    spread: Spread = field(default_factory=Spread)

    def made_diameter_nm(
        self, written_nm: Array | float, isolation: Array | float = 0.0
    ) -> Array:
        """Diameter at half height that comes out of a drawn pillar: bias, and corners
        that round off.

        Args:
            written_nm: equal-area diameter of the drawn polygon.
            isolation: of each pillar, see
                :func:`layout.process.isolation.isolation_map`.
        """
        written = np.asarray(written_nm, float)
        return self.bias.fabricated_nm(written - self._rounding_nm(written), isolation)

    def written_diameter_nm(
        self, design_nm: Array | float, isolation: Array | float = 0.0
    ) -> Array:
        """Drawn diameter that makes a designed diameter, to 1e-9 nm.

        Inverse of :meth:`made_diameter_nm`, by fixed-point iteration over the rounding:
        written = bias.drawn_nm(design) + rounding(written).

        Args:
            design_nm: diameter at half height.
            isolation: of each pillar, see
                :func:`layout.process.isolation.isolation_map`.
        """
        without_rounding = self.bias.drawn_nm(design_nm, isolation)
        written = without_rounding.copy()
        for _ in range(30):
            previous, written = written, without_rounding + self._rounding_nm(written)
            if np.abs(written - previous).max(initial=0.0) < 1e-10:
                break
        return np.asarray(written)

    def top_foot_nm(
        self, diameter_nm: Array | float, height_nm: float
    ) -> tuple[Array, Array]:
        """Diameters at the top and at the foot of a pillar with tilted walls.

        top, foot = diameter -+ height tan(sidewall angle).

        Args:
            diameter_nm: at half height.
            height_nm: of the pillar.
        """
        lean = height_nm * math.tan(self.etch.sidewall_deg * deg)
        middle = np.asarray(diameter_nm, float)
        return middle - lean, middle + lean

    def _rounding_nm(self, written_nm: Array) -> Array:
        """Equal-area diameter lost where the corners of a polygon round off, nm.

        n corners of radius r lose the area n r^2 (tan(pi/n) - pi/n), and r is at most
        the radius of the pillar. The diameter lost is 2 area / (pi written).

        Args:
            written_nm: equal-area diameter of the drawn polygon.
        """
        n = self.rules.vertices
        radius = np.minimum(self.etch.corner_radius_nm, written_nm / 2)
        area = n * radius**2 * (math.tan(math.pi / n) - math.pi / n)
        return np.asarray(2 * area / (math.pi * np.maximum(written_nm, 1e-9)))


def load_process(path: str | Path | None) -> Process:
    """Read PROCESS.toml; CSV files that it names lie in its folder.

    Args:
        path: of PROCESS.toml; None: the defaults.

    Raises:
        ConfigError: missing file, unknown key, wrong type or impossible value, with
            file and key.
        ProcessError: a bias table that is unreadable or impossible.
    """
    if path is None:
        return Process()
    path = Path(path)
    process = config.load(path, Process)
    return resolve_process(process, path.parent)


def resolve_process(process: Process, folder: str | Path) -> Process:
    """``process`` with its CSV files in ``folder``, and the bias table read."""
    folder = Path(folder)
    process = dataclasses.replace(process, bias=with_table(process.bias, folder))
    if process.exposure.csv is not None:
        table = folder / process.exposure.csv
        if not table.is_file():
            raise ConfigError(
                f"exposure.csv: {table}: no such file; need radius and energy density in two columns"
            )
        process = dataclasses.replace(
            process, exposure=dataclasses.replace(process.exposure, csv=table)
        )
    return process


def check_positive(record: Any, *names: str) -> None:
    """Refuse fields of a record, numbers or several, that are not finite and above 0;
    None is left out.
    """
    for name in names:
        value = getattr(record, name)
        if value is not None and not all(
            0 < v < math.inf for v in np.atleast_1d(value)
        ):
            raise ProcessError(f"{name} = {value}: need a finite value above 0")
