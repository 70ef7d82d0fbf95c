"""The run that is planned: its lens, its eyes, and its optics at any setting of any
knob.

The true image has one knob, its tolerance: field points, depths, wavelengths and
patches follow from it. The image of
one PSF a depth has four. Pillars and mask are judged in either.
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import torch

from codesign.budget import task
from codesign.budget.response import between
from codesign.budget.task import TaskSetting, Views
from codesign.optics import (
    Aperture,
    Device,
    Numerics,
    Window,
    device,
    gathered,
    kernels,
)
from metalens import design, library
from metalens.cell import Cell
from metalens.design import Focus
from metalens.ground.arrays import Array
from metalens.ground.errors import ConfigError
from metalens.image import Grid, Imager, PsfBasis
from metalens.lens import Lens
from metalens.pillars import Sweep
from metalens.psf import Source, spectrum

PILLARS: dict[str, tuple[float, ...]] = {"library_tolerance": (3e-2, 1e-2, 1e-3, 1e-4)}
MASK: dict[str, tuple[float, ...]] = {"diameter_step_nm": (20, 10, 5, 2, 1)}
LEVELS: dict[
    str, tuple[float, ...]
] = {  # of one PSF a depth; coarsest first, the last of each is the finest
    **PILLARS,
    "depth_count": (4, 6, 8, 12, 16, 24, 32, 48),
    "wavelength_count": (1, 2, 3, 4, 6, 8),
    "psf_tolerance": (3e-2, 1e-2, 1e-3, 1e-4, 1e-5),
    "kernel_tolerance": (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4),
    **MASK,
}
TRUE_LEVELS: dict[str, tuple[float, ...]] = {
    **PILLARS,
    "image_tolerance": (0.2, 0.1, 0.05, 0.03, 0.02),
    **MASK,
}
PILOT = Numerics(12, 1, 1e-4, 1e-4)  # of the other knobs while one is looked at
TRUE_PILOT = 0.1  # the same: tolerance of the true image
SETTLE_STEPS = 2  # of the estimator, which starts at the true state

LIGHT = (
    "the light of a plan is one wavelength or a diode about it (wavelength_nm, led_fwhm_nm); measured curves, single "
    "lines and sources of finite size are for metalens psf"
)
LAYERS = "the lens of a plan has neither glass nor stop; metalens budget LENS reckons with them"

Kind = Literal["true", "uniform"]
Optics = PsfBasis | Imager
Imaging = (
    Numerics | float
)  # how the optics are computed: numerics of one PSF a depth, or the true image's tolerance


@dataclass(frozen=True, slots=True)
class PlanConfig:
    """PLAN.toml: the lens and the run that is planned.

    image: "true", through the field, the spectrum and the films of the device; or
    "uniform", one PSF a depth.
    stacks: sets of PSFs that the run computes. frames: images that it forms.
    aperture_mm: diameter of the lens. wavelength_nm: of the design. sensor_distance_mm:
    from lens to sensor.
    source_distance_mm: at which the lens is focused. led_fwhm_nm: width of the source's
    spectrum; 0 for one wavelength.
    cell: of the pillars. task: what is looked at.
    """

    ELSEWHERE: ClassVar[dict[str, str]] = {
        "spectrum": LIGHT,
        "wavelengths_nm": LIGHT,
        "layers": LAYERS,
    }

    aperture_mm: float = 1.0
    wavelength_nm: float = field(default=850.0, metadata={"above": 0})
    sensor_distance_mm: float = field(default=2.0, metadata={"above": 0})
    source_distance_mm: float = field(default=20.0, metadata={"above": 0})
    led_fwhm_nm: float = 0.0
    image: Kind = "true"
    stacks: int = 200
    frames: int = 10_000
    cell: Cell = library.DEFAULT_CELL
    task: TaskSetting = field(default_factory=TaskSetting)

    def __post_init__(self) -> None:
        if not (
            0.02 <= self.aperture_mm <= 4
            and self.stacks >= 1
            and self.frames >= 1
            and self.led_fwhm_nm >= 0
        ):
            raise ConfigError(
                f"aperture_mm = {self.aperture_mm}, stacks = {self.stacks}, frames = {self.frames}, led_fwhm_nm = "
                f"{self.led_fwhm_nm}: need 0.02 to 4 mm, 1 or more of both, and a width of 0 or more"
            )
        square = self.cell.lattice.kind == "square"
        if not square or not self.cell.alike:
            raise ConfigError(
                f"cell.{'shape' if square else 'lattice'}: {self.cell.described}: a plan is of unpolarised light and "
                "needs pillars on a square lattice that answer x and y alike (metalens psf, layout and view take any)"
            )
        if self.source is not None:
            spectrum.points(
                self.source
            )  # refused now, not after the floor was measured

    @property
    def source(self) -> Source | None:
        """The diode; None for one wavelength."""
        return (
            Source(self.wavelength_nm, self.led_fwhm_nm) if self.led_fwhm_nm else None
        )

    @property
    def geometry(self) -> tuple[float, float, float]:
        """Sensor distance in mm, wavelength in nm and aperture in mm: what a reader is
        trained before.
        """
        return self.sensor_distance_mm, self.wavelength_nm, self.aperture_mm

    @property
    def focus(self) -> Focus:
        """What the lens images onto what."""
        return Focus(
            self.wavelength_nm * 1e-3,
            self.sensor_distance_mm * 1e3,
            self.source_distance_mm * 1e3,
        )


@dataclass(frozen=True, slots=True)
class Choice:
    """A setting of every knob of the image of one PSF a depth."""

    library_tolerance: float
    depth_count: int
    wavelength_count: int
    psf_tolerance: float
    kernel_tolerance: float
    diameter_step_nm: float

    @property
    def imaging(self) -> Imaging:
        """Of the optics."""
        return Numerics(
            self.depth_count,
            self.wavelength_count,
            self.psf_tolerance,
            self.kernel_tolerance,
        )


@dataclass(frozen=True, slots=True)
class TrueChoice:
    """A setting of every knob of the true image."""

    library_tolerance: float
    image_tolerance: float
    diameter_step_nm: float

    @property
    def imaging(self) -> Imaging:
        """Of the optics."""
        return self.image_tolerance


class Chain:
    """The run to plan: its lens, eyes, and pillars at every library tolerance, computed
    when first asked for.

    levels: of every knob. around: setting of the optics while another knob is looked
    at.
    """

    def __init__(
        self, config: PlanConfig, say: Callable[[str], None] = lambda text: None
    ) -> None:
        config = replace(
            config,
            task=replace(
                config.task, sensor_distance_um=config.focus.sensor_distance_um
            ),
        )
        self.config, self.say = config, say
        self.levels = levels_of(config)
        self.around: Imaging = TRUE_PILOT if self.true else PILOT
        self._libraries: dict[float, tuple[library.PillarLibrary, float]] = {}
        self.states = config.task.states
        self.eyes: Views = task.views(config.task, self.states)
        self.window = Window(*self.eyes.depths_um, config.task.pitch_um)
        self.lens = self._design()
        self.aperture = Aperture(self.lens)
        self.device = functools.cache(self._device)

    @property
    def true(self) -> bool:
        """Whether eyes are seen by the true image."""
        return self.config.image == "true"

    @property
    def finest(self) -> Choice | TrueChoice:
        """The finest setting of every knob."""
        return self.choice([row[-1] for row in self.levels.values()])

    def choice(self, values: list[float]) -> Choice | TrueChoice:
        """Settings in the order of ``levels``."""
        return choice_of(list(self.levels), values)

    def library(self, tolerance: float) -> tuple[library.PillarLibrary, float]:
        """The library at a tolerance, and the processor seconds it took."""
        if tolerance not in self._libraries:
            start = time.perf_counter()
            waves = (self.config.wavelength_nm * 1e-3,)
            made = library.sweep(self.config.cell, Sweep(waves, tolerance=tolerance))
            self._libraries[tolerance] = made, time.perf_counter() - start
            self.say(f"library at {tolerance:g}: {made.solves} solves")
        return self._libraries[tolerance]

    def table(self, tolerance: float) -> Array:
        """t of the aperture's diameters in the library of this tolerance."""
        made, _ = self.library(tolerance)
        return between(
            made.t[:, 0, 0].mean(0), made.diameter_um, self.aperture.diameter_um
        )

    def optics(self, table: Array, imaging: Imaging) -> Optics:
        """The lens with these pillars: the true image at a tolerance, or kernels of one
        PSF a depth.
        """
        maps = self.aperture.maps(table)
        if isinstance(imaging, Numerics):
            return kernels(
                self.lens, maps, imaging, self.window, fwhm_nm=self.config.led_fwhm_nm
            )
        seen = self.device(imaging)
        return seen.image(wave=gathered(self.lens, *maps, window_um=seen.window_um))

    def _device(self, tolerance: float) -> Device:
        """The designed lens as a true image, whose field points, depths, wavelengths
        and patches all pillars share.
        """
        setting, lens = self.config.task, self.lens
        grid = Grid(
            (setting.pixels,) * 2,
            setting.pitch_um,
            self.eyes.depths_um,
            setting.margin,
            2 * setting.margin + 1,
        )
        maps = self.aperture.maps(self.aperture.designed())
        return device(
            gathered(lens, *maps, window_um=grid.window * grid.step_um), grid, layers=lens.layers,
            distance_um=lens.sensor_distance_um, tolerance=tolerance,
            spectrum=self.config.source,
        )  # fmt: skip

    def electrons(self, optics: Optics) -> torch.Tensor:
        """Images of the eyes."""
        return task.electrons(self.eyes.anchor, optics, self.config.task)

    def read(self, images: torch.Tensor, believed: Optics) -> torch.Tensor:
        """(scenes, unknowns) where the estimate of the eyes' states comes to rest, less
        the true ones.
        """
        return task.settle(
            images,
            believed,
            self.states,
            self.config.task,
            seen=self.eyes,
            steps=SETTLE_STEPS,
        )

    def _design(self) -> Lens:
        made, _ = self.library(self.levels["library_tolerance"][0])
        focus, aperture_um = self.config.focus, self.config.aperture_mm * 1e3
        wanted = design.phase_of(None, focus, radius_um=aperture_um / 2)
        return design.make(
            wanted,
            focus,
            aperture_um=aperture_um,
            cell=made.cell,
            proxy=library.proxy_of(made),
            profile="hyperbolic",
        )[0]


def levels_of(config: PlanConfig) -> dict[str, tuple[float, ...]]:
    """Settings of every knob of a run's optics; light of one wavelength has one number
    of them.
    """
    if config.image == "true":
        return dict(TRUE_LEVELS)
    return dict(LEVELS) if config.led_fwhm_nm else LEVELS | {"wavelength_count": (1.0,)}


def choice_of(names: list[str], values: list[float]) -> Choice | TrueChoice:
    """The record of settings by name; counts are whole numbers."""
    given = {
        n: int(v) if n.endswith("count") else v
        for n, v in zip(names, values, strict=True)
    }
    return TrueChoice(**given) if "image_tolerance" in given else Choice(**given)  # type: ignore[arg-type]
