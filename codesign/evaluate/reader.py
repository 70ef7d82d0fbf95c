"""A fixed, small network that is trained on the images of any lens; its depth and
slippage errors rate the lens.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codesign.batches import (
    EXPERIMENT,
    TEST,
    VALIDATION,
    EyeScenes,
    PoolScenes,
    SceneConfig,
    SceneSource,
    depth_um,
    render_pool,
    sensor_irradiance,
)
from codesign.evaluate.scene_image import lens_imager, margin_of
from codesign.eye import PinholeCamera
from codesign.network import blur, losses
from codesign.network.blur import BlurBranch
from codesign.settings import LARGEST, LEAST, check_ranges
from codesign.train import bootstrap_interval, read_out
from metalens.core.errors import ConfigError
from metalens.core.report import Table
from metalens.image import Imager, Sensor
from metalens.lens import Lens

SHARE = 0.9  # coverage of the intervals


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
    tolerance: of the true image.
    """

    frames: int = 6400
    pool: int = 1024
    test: int = 256
    seed: int = 0
    pixels: int = 64
    pitch_um: float = 18.0
    electrons: float = 2000.0
    fwhm_nm: float = 0.0
    depths_mm: tuple[float, float] = (12.0, 50.0)
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
        )

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred into them."""
        return margin_of(self.pitch_um)

    @property
    def sensor(self) -> Sensor:
        """Pixels of this pitch: 5 electrons of read noise, full well at twice the white
        object's light, 10 bits.
        """
        return Sensor(
            self.pitch_um, 9.0, self.electrons, 0.0, 2 * self.electrons, 5.0, 10
        )


BATCH = 32
SLIP_SCALE_MM = torch.tensor([1.4, 1.2, 2.3])


@dataclass(frozen=True, eq=False, slots=True)
class ReaderResult:
    """Absolute errors of the reader on the test frames of one lens.

    axial_mm, lateral_mm: (frames,) error of the slippage.
    window_mm: (frames,) error of the windows' depths, mean over a frame.
    guess_mm: mean error of the best constant depth.
    covered: share of frames within the calibrated 90 % interval of axial slippage.
    interval_mm: half width of that interval.
    image_error: relative L2 error of the images.
    """

    axial_mm: Tensor
    lateral_mm: Tensor
    window_mm: Tensor
    guess_mm: float
    covered: float
    interval_mm: float
    image_error: float

    def values(self) -> dict[str, float]:
        """Mean errors by name, the axial one with its 95 % bootstrap interval over the
        frames.
        """
        low, high = bootstrap_interval(self.axial_mm.numpy())
        values = {name: getattr(self, name) for name in ReaderResult.__slots__}
        means = {name: float(torch.as_tensor(v).mean()) for name, v in values.items()}
        return means | {"axial_low_mm": low, "axial_high_mm": high}


class ReferenceReader(nn.Module):
    """The blur branch, and a small network from its features to the slippage (x, y, z)
    in units of ``SLIP_SCALE_MM``.
    """

    def __init__(self) -> None:
        super().__init__()
        self.branch = BlurBranch(nn.BatchNorm2d(blur.FEATURES))
        self.slip = nn.Sequential(
            nn.BatchNorm1d(blur.SLIP_FEATURES),
            nn.Dropout(0.1),
            nn.Linear(blur.SLIP_FEATURES, 128),
            nn.GELU(),
            nn.Dropout(0.2),
            nn.Linear(128, 64),
            nn.GELU(),
            nn.Linear(64, 3),
        )


@dataclass(frozen=True, eq=False, slots=True)
class LensFrames:
    """Sensor frames of one lens with their true values.

    pixels: (n, 1, y, x). vergence: (n, windows, windows). slip_mm: (n, 3).
    """

    pixels: Tensor
    vergence: Tensor
    slip_mm: Tensor


def render_scenes(
    config: ReaderConfig, *, sensor_distance_um: float
) -> list[SceneSource]:
    """Render the training, calibration and test scenes for lenses of one sensor
    distance.

    Frames are drawn at random scales, so that the size of an eye does not give away its
    depth.

    Args:
        config: frames, sensor and light of the reader.
        sensor_distance_um: distance from lens to sensor.

    Raises:
        ConfigError: eyes out of the depths of the PSFs.
    """
    scenes = SceneConfig(pixels=config.pixels, margin=config.margin)
    nearest, farthest = (1e-3 * depth for depth in scenes.pupil_depths_um)
    if not config.depths_mm[0] <= nearest <= farthest <= config.depths_mm[1]:
        raise ConfigError(
            f"reader: depths_mm = {config.depths_mm} do not hold the eyes, {nearest:g} to {farthest:g} mm before the lens"
        )
    sources: list[SceneSource] = []
    for stream in (EXPERIMENT, VALIDATION, TEST):
        eyes = EyeScenes(
            scenes, config.pitch_um, sensor_distance_um, config.seed + 101, stream
        )
        count = config.pool if stream == EXPERIMENT else config.test
        pool = render_pool(eyes, count)
        sources.append(
            PoolScenes(pool, config.margin, scenes.scale, config.seed + stream)
        )
    return sources


def train_reader(
    optics: Imager, scenes: Sequence[SceneSource], config: ReaderConfig
) -> ReaderResult:
    """Train the reference reader on images of a lens and test it.

    The result is reproducible: torch's random state is seeded and restored.

    Args:
        optics: imager of the lens.
        scenes: of :func:`render_scenes`, the same for every lens.
        config: frames, sensor and light of the reader.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        reader = ReferenceReader()
        training, calibration, test = (
            lens_frames(optics, source, config, count)
            for source, count in zip(
                scenes, (config.frames, config.test, config.test), strict=True
            )
        )
        _train_depth(reader, training)
        _train_slip(reader, training)
        reader.eval()
        return _evaluate(reader, calibration, test, optics.error)


@torch.no_grad()
def lens_frames(
    optics: Imager, scenes: SceneSource, config: ReaderConfig, count: int
) -> LensFrames:
    """Noisy sensor frames of a stream of scenes through a lens.

    Args:
        optics: imager of the lens.
        scenes: source of the frames.
        config: frames, sensor and light of the reader; seed of the noise.
        count: frames, a multiple of 32.
    """
    parts = []
    pitch = torch.tensor(config.pitch_um, dtype=torch.float64)
    for number in range(count // BATCH):
        batch = scenes.batch(number, BATCH)
        light = sensor_irradiance(batch.frames, optics)
        noise = torch.Generator().manual_seed(7_000_003 * (config.seed + 1) + number)
        pixels = read_out(
            light, config.pitch_um, pitch, config.sensor, generator=noise, exact=False
        )
        depths = depth_um(batch.frames, margin=config.margin)
        parts.append((pixels, blur.window_vergence(depths), batch.slip_mm))
    return LensFrames(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _train_depth(
    reader: ReferenceReader, training: LensFrames, *, passes: int = 4, batch: int = 64
) -> None:
    """Train the blur branch on the vergence of the windows."""
    for rows in _training_batches(
        reader.branch, len(training.pixels), passes, batch, rate=3e-3, decay=0.01
    ):
        predicted, _ = reader.branch(training.pixels[rows])
        losses.depth_loss(predicted, training.vergence[rows]).backward()  # type: ignore[no-untyped-call]


def _train_slip(
    reader: ReferenceReader, training: LensFrames, *, passes: int = 12, batch: int = 128
) -> None:
    """Train the slippage network on the features of the trained blur branch, by the
    smooth L1 loss.
    """
    features = _features(reader, training)
    truth = training.slip_mm / SLIP_SCALE_MM
    for rows in _training_batches(
        reader.slip, len(features), passes, batch, rate=2e-3, decay=0.03
    ):
        loss = F.smooth_l1_loss(reader.slip(features[rows]), truth[rows], beta=0.3)
        loss.backward()  # type: ignore[no-untyped-call]


def _training_batches(
    module: nn.Module, count: int, passes: int, batch: int, *, rate: float, decay: float
) -> Iterator[Tensor]:
    """Row numbers of each training batch; after each, one step of AdamW.

    The caller computes the gradients between two batches. The learning rate follows one
    cycle (OneCycleLR).

    Args:
        module: network to train.
        count: number of training frames.
        passes: passes over all frames.
        batch: frames of a batch.
        rate: highest learning rate.
        decay: weight decay.
    """
    module.train()
    optimiser = torch.optim.AdamW(module.parameters(), lr=rate, weight_decay=decay)
    total = passes * max(count // batch, 1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=total)
    for _ in range(passes):
        order = torch.randperm(count)
        for step in range(max(count // batch, 1)):
            optimiser.zero_grad(set_to_none=True)
            yield order[step * batch : (step + 1) * batch]
            optimiser.step()
            schedule.step()
    module.eval()


@torch.no_grad()
def _features(reader: ReferenceReader, frames: LensFrames) -> Tensor:
    """(n, features) of the blur branch, 256 frames at a time."""
    return torch.cat(
        [reader.branch(part)[1] for part in torch.split(frames.pixels, 256)]
    )


@torch.no_grad()
def _evaluate(
    reader: ReferenceReader,
    calibration: LensFrames,
    test: LensFrames,
    image_error: float,
) -> ReaderResult:
    """Errors on the test frames, with intervals from the calibration frames.

    The half width of the 90 % interval is the split-conformal quantile of the errors of
    the calibration frames.
    """
    held_out, error = (
        (reader.slip(_features(reader, frames)) * SLIP_SCALE_MM - frames.slip_mm).abs()
        for frames in (calibration, test)
    )
    ordered = held_out[:, 2].sort().values
    rank = min(math.ceil(SHARE * (len(ordered) + 1)), len(ordered))
    half_width = ordered[rank - 1]
    depths = [reader.branch(part)[0] for part in torch.split(test.pixels, 256)]
    truth = blur.depth_mm(test.vergence)
    window_error = (blur.depth_mm(torch.cat(depths)[:, 0]) - truth).abs()
    return ReaderResult(
        axial_mm=error[:, 2],
        lateral_mm=error[:, :2].mean(1),
        window_mm=window_error.mean((1, 2)),
        guess_mm=float((truth - truth.median()).abs().mean()),
        covered=float((error[:, 2] <= half_width).float().mean()),
        interval_mm=float(half_width),
        image_error=image_error,
    )


def reader_table(results: dict[str, ReaderResult], config: ReaderConfig) -> Table:
    """Table with a row of errors for each lens.

    Args:
        results: result by name of the lens.
        config: frames, sensor and light of the reader.
    """
    light = f"{config.fwhm_nm:g} nm of light" if config.fwhm_nm else "one wavelength"
    caption = (
        f"Read by the reference reader: {config.frames} frames of {config.pixels} pixels of {config.pitch_um:g} µm, "
        f"{config.electrons:g} e, {light}, whole field; 95 % interval over {config.test} test frames."
    )
    columns = {
        "axial / mm": "{axial_mm:.2f} [{axial_low_mm:.2f}, {axial_high_mm:.2f}]",
        "90 % interval": "±{interval_mm:.2f} mm",
        "covers": "{covered:.0%}",
        "lateral / mm": "{lateral_mm:.2f}",
        "windows / mm (guess)": "{window_mm:.2f} ({guess_mm:.2f})",
        "image error": "{image_error:.3f}",
    }
    rows = [
        (name, *(column.format(**result.values()) for column in columns.values()))
        for name, result in results.items()
    ]
    return Table(("lens", *columns), rows, caption)


def judge_lenses(
    lenses: dict[str, Lens], config: ReaderConfig
) -> Iterator[tuple[str, ReaderResult]]:
    """Name and result of every lens, trained and tested on the same scenes.

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
    scenes = render_scenes(config, sensor_distance_um=next(iter(distances.values())))
    nearest, farthest = config.depths_mm
    for name, lens in lenses.items():
        optics = lens_imager(
            lens,
            PinholeCamera(config.pixels, config.pitch_um),
            (nearest * 1e3, farthest * 1e3),
            fwhm_nm=config.fwhm_nm,
            tolerance=config.tolerance,
        )
        yield name, train_reader(optics, scenes, config)
