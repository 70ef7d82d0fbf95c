"""What the links of a budget are judged with: the lens as a device, its eyes, and the
reader of its images.
"""

from dataclasses import dataclass, field, replace

import torch

from characterize.inference import AsBuilt
from codesign.adapt import FinishedRun as Run
from codesign.budget import task
from codesign.budget.entry import NONE, BudgetEntry
from codesign.budget.reading import NetworkReading
from codesign.budget.task import LinearEstimator, TaskSetting
from codesign.evaluate import ExperimentConfig
from codesign.optics import (
    ImageWindow,
    ImagingDevice,
    OpticsConfig,
    OpticsNumerics,
    PillarCells,
    TabulatedLens,
    gather_lens_plane,
    image_difference,
    make_device,
    pixel_kernels,
)
from codesign.train import assess
from metalens.core.errors import LensError
from metalens.fabrication import Printed
from metalens.image import Grid, Imager, PsfBasis
from metalens.lens import Lens
from metalens.library import PillarLibrary
from metalens.psf import Source


@dataclass(frozen=True, slots=True)
class BudgetInputs:
    """What is known beside the lens: each adds its entries.

    numerics: of the chain. fwhm_nm: of the light source. mask: of the PROCESS.toml.
    library: that the proxy was fitted
    to. asbuilt: of a fit. run: of a finished co-design run, whose reader answers.
    frames: that it is shown. draws: of
    process and fit.
    """

    numerics: OpticsNumerics = field(default_factory=OpticsNumerics)
    fwhm_nm: float = 0.0
    mask: Printed | None = None
    library: PillarLibrary | None = None
    asbuilt: AsBuilt | None = None
    run: Run | None = None
    frames: ExperimentConfig = field(
        default_factory=lambda: ExperimentConfig(subjects=5)
    )
    draws: int = 4
    tolerance: float = 1e-3


@dataclass(eq=False, slots=True)
class PreparedDevice:
    """The lens as a device, who reads its images, and the finest one-PSF optics that
    numerics are compared with.

    device: the true image of the designed pillars. reader: the linear estimator that
    knows it. reading: of a run's
    network instead, where one is given.
    """

    lens: Lens
    given: BudgetInputs
    setting: TaskSetting
    aperture: TabulatedLens
    finest: OpticsNumerics
    window: ImageWindow
    eyes: task.RenderedViews
    device: ImagingDevice
    reader: LinearEstimator
    reading: NetworkReading | None

    @property
    def above(self) -> list[str]:
        """Why the errors of the images are above their tolerance: of the pillars, and
        of the run's smooth phase.
        """
        return [
            self.device.above,
            *([] if self.reading is None else [self.reading.true.above]),
        ]

    @property
    def image_tolerance(self) -> float:
        """Of the image that the reader sees."""
        if self.reading is None:
            return self.device.tolerance
        return self.reading.true.tolerance

    def turned_on_finer_image(self) -> float:
        """Mean angle, rad, between answers to the image and to one of a finer
        tolerance.

        Raises:
            SceneError, PropagationError: it cannot be formed.
        """
        if self.reading is not None:
            return self.reading.turned_on_finer_image()
        here = self.device
        fine = make_device(
            here.wave,
            here.whole.grid,
            layers=here.layers,
            distance_um=here.distance_um,
            spectrum=self.source,
            tolerance=here.tolerance / assess.FINER,
        )
        return task.gaze_mean(self.shift(fine.whole, here.whole))

    @property
    def source(self) -> Source | None:
        """The diode; None for one wavelength."""
        width = self.given.fwhm_nm
        return Source(self.lens.wavelength_um * 1e3, width) if width else None

    def gathered(
        self, phase: torch.Tensor, level: torch.Tensor, *, lens: Lens | None = None
    ) -> PillarCells:
        """The lens plane of other pillars, over cells as the device's."""
        return gather_lens_plane(
            lens or self.lens, phase, level, window_um=self.device.window_um
        )

    def basis(self, numerics: OpticsNumerics) -> PsfBasis:
        """One-PSF kernels of the designed lens."""
        maps = self.aperture.maps(self.aperture.designed())
        return pixel_kernels(
            self.lens, maps, numerics, self.window, fwhm_nm=self.given.fwhm_nm
        )

    def shift(self, optics: PsfBasis | Imager, base: PsfBasis | Imager) -> torch.Tensor:
        """(scenes, unknowns) change of the linear estimator's answer between images
        through two optics.
        """
        one, other = (
            task.expected_electrons(self.eyes.anchor, o, self.setting)
            for o in (optics, base)
        )
        return self.reader.shift(one) - self.reader.shift(other)

    def entry(
        self, link: str, optics: Imager, method: str, *, phase_rad: float = NONE
    ) -> BudgetEntry:
        """The entry of a change of the device, before the network or the linear
        estimator.
        """
        base = self.device.whole
        if self.reading is not None:
            return self.reading.changed(link, optics, base, method, phase_rad=phase_rad)
        gaze = task.gaze_mean(self.shift(optics, base))
        return BudgetEntry(
            link, phase_rad, image_difference(optics, base), gaze, method
        )


def prepare_device(
    lens: Lens, given: BudgetInputs, setting: TaskSetting | None = None
) -> PreparedDevice:
    """Render the eyes, prepare the device and its reader; the finest optics have twice
    the depths (64 at most).

    Raises:
        LensError: the run's lens is another than the one given; turned pillars, or
            another lattice than a square one.
    """
    setting = replace(
        setting or TaskSetting(), sensor_distance_um=lens.reduced_um
    )  # as the true image maps directions
    aperture, eyes = TabulatedLens(lens), task.render_views(setting)
    finest = finest_of(given.numerics, fwhm_nm=given.fwhm_nm)
    window = ImageWindow(*eyes.depths_um, setting.pitch_um)
    if given.run is not None:
        same_lens(lens, given.run.settings.optics)
    maps, reading, known = aperture.maps(aperture.designed()), None, None
    if given.run is not None:
        reading = NetworkReading(given.run, given.frames, fwhm_nm=given.fwhm_nm)
        wave = gather_lens_plane(lens, *maps, window_um=reading.true.window_um)
        seen = reading.stands(wave, lens.layers, lens.sensor_distance_um)
        known = pixel_kernels(lens, maps, finest, window, fwhm_nm=given.fwhm_nm)
    else:
        grid = Grid(
            (setting.pixels,) * 2,
            setting.pitch_um,
            eyes.depths_um,
            setting.margin,
            2 * setting.margin + 1,
        )
        wave = gather_lens_plane(lens, *maps, window_um=grid.window * grid.step_um)
        line = (
            Source(lens.wavelength_um * 1e3, given.fwhm_nm) if given.fwhm_nm else None
        )
        seen = make_device(
            wave,
            grid,
            layers=lens.layers,
            distance_um=lens.sensor_distance_um,
            spectrum=line,
        )
    reader = task.linear_estimator(eyes, known or seen.whole, setting)
    return PreparedDevice(
        lens, given, setting, aperture, finest, window, eyes, seen, reader, reading
    )


def finest_of(numerics: OpticsNumerics, *, fwhm_nm: float) -> OpticsNumerics:
    """What settings are compared with: twice the depths (64 at most), six more
    wavelengths, a tenth of the tolerances
    or 1e-5 and 1e-4."""
    return OpticsNumerics(
        min(2 * numerics.depth_count, 64),
        numerics.wavelength_count + 6 if fwhm_nm else 1,
        min(numerics.psf_tolerance / 10, 1e-5),
        min(numerics.basis_tolerance / 10, 1e-4),
    )


def same_lens(lens: Lens, optics: OpticsConfig) -> None:
    """Refuse a reader that was trained before another lens: one that differs by more
    than 2 %.

    Raises:
        LensError: sensor distance, wavelength or aperture differ.
    """
    mine = (
        lens.sensor_distance_um * 1e-3,
        lens.wavelength_um * 1e3,
        2e-3 * lens.diameters.radius_um,
    )
    its = optics.sensor_distance_mm, optics.wavelength_nm, optics.aperture_mm
    if any(abs(a - b) > 0.02 * b for a, b in zip(mine, its, strict=True)):
        raise LensError(
            "the run's reader was trained before another lens: sensor distance, wavelength, aperture are "
            f"{its[0]:g} mm, {its[1]:g} nm, {its[2]:g} mm there and {mine[0]:g} mm, {mine[1]:g} nm, {mine[2]:g} mm in "
            "the lens file; give the lens.h5 of the run"
        )
