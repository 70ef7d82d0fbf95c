"""The reference reader: a small network trained on the images of a lens, whose errors
rate that lens.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import torch

from codesign.batches import (
    CALIBRATION,
    EXPERIMENT,
    TEST,
    EyeScenes,
    PoolScenes,
    SceneConfig,
    render_pool,
)
from codesign.evaluate.scene_image import margin_of
from codesign.network import SearchSpace, blur, smallest_architecture
from codesign.optics import PixelPsfStack, image_formation
from codesign.optics.stack import lens_settings
from codesign.settings import LARGEST, LEAST, check_ranges
from codesign.train import (
    InnerConfig,
    Trainer,
    assess,
    bootstrap_interval,
    make_model,
    results,
)
from metalens.core.errors import ConfigError
from metalens.core.report import Table
from metalens.image import Optics, PillarWave, Sensor, cell_um
from metalens.lens import Lens

BATCH = 32
SPACE = SearchSpace(
    widths=(0.25,), depths=(2,), kernels=(3,), expansions=(3,), resolution=(1.0, 1.0)
)
ARCHITECTURE = smallest_architecture(SPACE)


@dataclass(frozen=True, slots=True)
class ReaderConfig:
    """What the reference reader sees.

    frames: that it learns from, drawn from rendered ones at new scales; a multiple of
    32. pool: that are rendered.
    test: that judge it; as many again calibrate its intervals. seed: of everything.
    pixels, pitch_um: of the sensor, square. electrons: that a white object gives in a
    pixel of 9 um.
    fwhm_nm: spectral width of the light, 0 for one wavelength. depths_mm: that the PSFs
    cover.
    angle_deg: field angle, towards +x, of the middle of the frame.
    tolerance: of the true image.
    """

    frames: int = 12800
    pool: int = 1024
    test: int = 256
    seed: int = 0
    pixels: int = 64
    pitch_um: float = 18.0
    electrons: float = 2000.0
    fwhm_nm: float = 0.0
    depths_mm: tuple[float, float] = (12.0, 50.0)
    angle_deg: float = field(default=0.0, metadata={"signed": True})
    tolerance: float = field(default=0.03, metadata={"above": 0})

    def __post_init__(self) -> None:
        if min(self.frames, self.pool, self.test) < BATCH or (
            self.frames % BATCH or self.test % BATCH
        ):
            raise ConfigError(
                f"reader: frames = {self.frames}, pool = {self.pool}, test = {self.test}: need {BATCH} or more, frames "
                f"and test a multiple of {BATCH}"
            )
        check_ranges(
            self,
            pixels=(32, 512),
            pitch_um=(LEAST, LARGEST),
            electrons=(LEAST, LARGEST),
            fwhm_nm=(0, LARGEST),
            depths_mm=(LEAST, LARGEST),
            angle_deg=(-40, 40),
        )

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred into them."""
        return margin_of(self.pitch_um)

    @property
    def scenes(self) -> SceneConfig:
        """Frames of this size with their margin."""
        return SceneConfig(pixels=self.pixels, margin=self.margin)

    @property
    def sensor(self) -> Sensor:
        """Pixels of this pitch: 5 electrons of read noise, full well at twice the white
        object's light, 10 bits.
        """
        return Sensor(
            self.pitch_um, 9.0, self.electrons, 0.0, 2 * self.electrons, 5.0, 10
        )


@dataclass(frozen=True, eq=False, slots=True)
class TrainedReader:
    """The reference reader of one lens.

    lens, config: what it was trained on. trainer: with its network. stack: lens plane
    that forms its images.
    """

    lens: Lens
    config: ReaderConfig
    trainer: Trainer
    stack: PixelPsfStack

    def frames(self, stream: int, tolerance: float) -> assess.SensorFrames:
        """Test frames of a stream, on images of a tolerance.

        Args:
            stream: of the random generator.
            tolerance: relative L2 error of the image of a texture.
        """
        optics = replace(self.trainer.optics, image_tolerance=tolerance)
        scenes = _scenes_of(self.lens, self.config, stream)
        count = self.config.test // BATCH
        return assess.sensor_frames(
            self.trainer, scenes, count, stack=self.stack, optics=optics
        )


def _scenes_of(lens: Lens, config: ReaderConfig, stream: int) -> EyeScenes:
    seed = config.seed + 101
    return EyeScenes(config.scenes, config.pitch_um, lens.reduced_um, seed, stream)


@functools.lru_cache(maxsize=2)
def _lens_plane(lens: Lens, window_um: float) -> Optics:
    """Pillars of a lens with its films and distance; one for all readers of a lens."""
    device = lens.wavelength_um, window_um, lens.sensor_distance_um
    wave = PillarWave(lens, cell_um=cell_um(lens.layers, *device))
    return Optics(wave, lens.layers, lens.sensor_distance_um)


def train_reader(lens: Lens, config: ReaderConfig) -> TrainedReader:
    """Train the smallest network of the supernet on images of a lens.

    Args:
        lens: content of a lens file; it stays as it is.
        config: frames, sensor and light of the reader.
    """
    optics = replace(
        lens_settings(lens, config.fwhm_nm),
        sample_um=config.pitch_um,
        window_samples=2 * config.margin + 1,
        depths_mm=config.depths_mm,
        angle_deg=config.angle_deg,
        image_tolerance=config.tolerance,
    )
    plane = _lens_plane(lens, optics.window_samples * optics.sample_um)
    none = torch.zeros(0)
    stack = PixelPsfStack(none, none, plane)
    pool = render_pool(_scenes_of(lens, config, EXPERIMENT), config.pool)
    learned = PoolScenes(pool, config.margin, config.scenes.scale, config.seed)
    inner = InnerConfig(steps=config.frames // BATCH, batch=BATCH, seed=config.seed)
    with torch.random.fork_rng(devices=[]):
        model = make_model(
            optics, pitch_um=config.pitch_um, seed=config.seed, space=SPACE
        )
    trainer = Trainer(
        inner, optics, config.sensor, learned, model,
        architecture=ARCHITECTURE, stacks=[stack],
    )  # fmt: skip
    for _ in trainer.run():
        pass
    assess.recalibrate_network(trainer, ARCHITECTURE)
    return TrainedReader(lens, config, trainer, stack)


def judge_reader(
    reader: TrainedReader, tolerance: float | None = None
) -> dict[str, float]:
    """Errors of a reader on test frames that it has not seen.

    Args:
        reader: of one lens.
        tolerance: of the images that judge; those of training without it.

    Returns:
        mean absolute errors of the test frames by name, the axial one with its 95 %
            bootstrap interval; guess_mm is the error of one depth for all windows.
            interval_mm is the mean half width of the 90 % intervals, and covered the
            share of the frames that they hold.
    """
    config, trainer = reader.config, reader.trainer
    tolerance = tolerance or config.tolerance
    calibration, test = (
        reader.frames(stream, tolerance) for stream in (CALIBRATION, TEST)
    )
    judged, tested = (
        assess.predict_frames(trainer.model.net, ARCHITECTURE, frames, trainer.inner)
        for frames in (calibration, test)
    )
    half_mm = results.conformal_quantiles(judged, calibration) * tested.slip_sd_mm[:, 2]
    summary = results.uncertainty_summary(tested, test, half_mm)
    error_mm = (tested.slip_mm - test.slip_mm).abs()
    low, high = bootstrap_interval(error_mm[:, 2].numpy())
    depth_mm = blur.depth_mm(test.vergence)
    imager = image_formation.make_imager(
        replace(trainer.optics, image_tolerance=tolerance),
        torch.zeros(0),
        config.pixels + 2 * config.margin,
        margin=config.margin,
        made=reader.stack,
    )
    return {
        "axial_mm": float(error_mm[:, 2].mean()),
        "axial_low_mm": low,
        "axial_high_mm": high,
        "lateral_mm": float(error_mm[:, :2].mean()),
        "iou": float(tested.iou.mean()),
        "window_mm": summary["window_depth_mm"],
        "guess_mm": float((depth_mm - depth_mm.median()).abs().mean()),
        "covered": summary["axial_coverage_90"],
        "interval_mm": summary["axial_interval_mm"],
        "image_error": imager.error,
    }


def reader_table(judged: dict[str, dict[str, float]], config: ReaderConfig) -> Table:
    """Table with a row of errors for each lens.

    Args:
        judged: errors by name of the lens.
        config: frames, sensor and light of the reader.
    """
    light = f"{config.fwhm_nm:g} nm of light" if config.fwhm_nm else "one wavelength"
    caption = (
        f"Read by the reference reader: {config.frames} frames of {config.pixels} pixels of {config.pitch_um:g} µm, "
        f"{config.electrons:g} e, {light}, whole field; 95 % interval over {config.test} test frames."
    )
    columns = {
        "axial / mm": "axial_mm",
        "from": "axial_low_mm",
        "to (95 %)": "axial_high_mm",
        "90 % interval / mm": "interval_mm",
        "covers": "covered",
        "lateral / mm": "lateral_mm",
        "windows / mm": "window_mm",
        "guess / mm": "guess_mm",
        "image error": "image_error",
    }
    rows = [
        (name, *(errors[key] for key in columns.values()))
        for name, errors in judged.items()
    ]
    return Table(("lens", *columns), rows, caption, digits=3)


def judge_lenses(
    lenses: dict[str, Lens], config: ReaderConfig
) -> Iterator[tuple[str, dict[str, float]]]:
    """Name and errors of every lens, trained and tested on the same scenes.

    Args:
        lenses: lenses by name.
        config: frames, sensor and light of the reader.

    Raises:
        ConfigError: lenses of different sensor distances (through films: reduced),
            whose frames differ in size.
    """
    distances = {name: lens.reduced_um for name, lens in lenses.items()}
    if max(distances.values()) > min(distances.values()) * 1.001:
        raise ConfigError(
            f"lenses of different sensor distances {distances} um: compare lenses of one distance"
        )
    nearest, farthest = (1e-3 * depth for depth in config.scenes.pupil_depths_um)
    if not config.depths_mm[0] <= nearest <= farthest <= config.depths_mm[1]:
        raise ConfigError(
            f"reader: depths_mm = {config.depths_mm} do not hold the eyes, {nearest:g} to {farthest:g} mm before the lens"
        )
    for name, lens in lenses.items():
        yield name, judge_reader(train_reader(lens, config))
