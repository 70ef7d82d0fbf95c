"""A fixed, cheap reader that judges any lens by what a small reader really collects of
the depth in its images.
"""

import math
from collections.abc import Iterator
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
from codesign.evaluate.imaged import lens_imager, margin_of
from codesign.eye import PinholeCamera
from codesign.network import blur, losses
from codesign.network.blur import BlurBranch
from codesign.train import bootstrap_interval, read_out
from metalens.core import threads
from metalens.core.errors import ConfigError
from metalens.core.report import Table
from metalens.image import Imager, Sensor
from metalens.lens import Lens

SHARE = 0.9  # of the intervals


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
        if (
            min(self.frames, self.pool, self.test) < BATCH
            or self.frames % BATCH
            or self.test % BATCH
        ):
            raise ConfigError(
                f"reader: frames = {self.frames}, pool = {self.pool}, test = {self.test}: need {BATCH} or more, frames "
                f"and test a multiple of {BATCH}"
            )
        if not (
            32 <= self.pixels <= 512
            and self.pitch_um > 0
            and self.electrons > 0
            and self.fwhm_nm >= 0
        ):
            raise ConfigError(
                f"reader: pixels = {self.pixels}, pitch_um = {self.pitch_um}, electrons = {self.electrons}, fwhm_nm = "
                f"{self.fwhm_nm}: need 32 to 512 pixels, pitch and electrons above 0, a width of 0 or more"
            )
        near, far = self.depths_mm
        if not 0 < near < far < math.inf:
            raise ConfigError(
                f"reader: depths_mm = {self.depths_mm}: need 0 < least < largest"
            )

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred into them."""
        return margin_of(self.pitch_um)

    @property
    def camera(self) -> PinholeCamera:
        """Samples of the frames."""
        return PinholeCamera(self.pixels, self.pitch_um)

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
    """What was read of the test frames through one lens; errors absolute, (frames,).

    axial_mm, lateral_mm: of the slippage. window_mm: of the windows' depths, mean of
    each frame; guess_mm: of the best
    constant; trusted_mm: of the half of all windows whose depths it says it is surest
    of. covered: share of frames
    within the calibrated 90 % interval of the axial slippage, whose mean half width is
    interval_mm. image_error: of the
    image, relative L2.
    """

    axial_mm: Tensor
    lateral_mm: Tensor
    window_mm: Tensor
    guess_mm: float
    covered: float
    interval_mm: float
    image_error: float
    trusted_mm: float

    def values(self) -> dict[str, float]:
        """The numbers by name, axial with its 95 % interval by a bootstrap over the
        frames.
        """
        low, high = bootstrap_interval(self.axial_mm.numpy())
        return {
            "axial_mm": float(self.axial_mm.mean()), "axial_low_mm": float(low), "axial_high_mm": float(high),
            "lateral_mm": float(self.lateral_mm.mean()), "window_mm": float(self.window_mm.mean()),
            "guess_mm": self.guess_mm, "covered": self.covered, "interval_mm": self.interval_mm,
            "image_error": self.image_error, "trusted_mm": self.trusted_mm,
        }  # fmt: skip


class ReferenceReader(nn.Module):
    """The blur branch and a small network from its depths to the slippage with the
    logarithm of its spread.
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
            nn.Linear(64, 6),
        )


@dataclass(frozen=True, eq=False, slots=True)
class LensFrames:
    """Frames of one lens with their truth: pixels (n, 1, y, x), vergence (n, windows,
    windows), slip_mm (n, 3).
    """

    pixels: Tensor
    vergence: Tensor
    slip_mm: Tensor


@dataclass(frozen=True, eq=False, slots=True)
class JudgingScenes:
    """Scenes that are the same for every lens: to learn from, to calibrate and to
    judge.
    """

    learn: SceneSource
    calibrate: SceneSource
    judge: SceneSource


def render_scenes(config: ReaderConfig, *, sensor_distance_um: float) -> JudgingScenes:
    """Render what all lenses of this sensor distance are judged on; size tells no
    depth.

    Args:
        config: of the reference reader. sensor_distance_um: lens to sensor.

    Raises:
        ConfigError: eyes out of the depths of the PSFs.
    """
    scenes = SceneConfig(pixels=config.pixels, margin=config.margin)
    near, far = (1e-3 * depth for depth in scenes.pupil_depths_um)
    if not config.depths_mm[0] <= near <= far <= config.depths_mm[1]:
        raise ConfigError(
            f"reader: depths_mm = {config.depths_mm} do not hold the eyes, {near:g} to {far:g} mm before the lens"
        )
    of = {
        stream: EyeScenes(
            scenes, config.pitch_um, sensor_distance_um, config.seed + 101, stream
        )
        for stream in (EXPERIMENT, VALIDATION, TEST)
    }
    pools = {
        stream: render_pool(one, config.test if stream != EXPERIMENT else config.pool)
        for stream, one in of.items()
    }
    kept = {
        s: PoolScenes(p, config.margin, scenes.scale, config.seed + s)
        for s, p in pools.items()
    }
    return JudgingScenes(kept[EXPERIMENT], kept[VALIDATION], kept[TEST])


def train_reader(
    optics: Imager, seen: JudgingScenes, config: ReaderConfig
) -> ReaderResult:
    """Train the reader on images through ``optics`` and judge it; the same seed gives
    the same numbers.

    Args:
        seen: scenes to learn from, to calibrate and to judge.
        config: of the reference reader.
    """
    threads.keep_memory()
    state = torch.get_rng_state()
    torch.manual_seed(config.seed)
    try:
        made = ReferenceReader()
        learn = lens_frames(optics, seen.learn, config, config.frames)
        _learn_depth(made, learn)
        _learn_slip(made, learn)
        made.eval()
        spare = lens_frames(optics, seen.calibrate, config, config.test)
        judged = lens_frames(optics, seen.judge, config, config.test)
        return _judge(made, spare, judged, float(getattr(optics, "error", math.nan)))
    finally:
        torch.set_rng_state(state)


@torch.no_grad()
def lens_frames(
    optics: Imager, scenes: SceneSource, config: ReaderConfig, count: int
) -> LensFrames:
    """``count`` frames of a stream through a lens onto the sensor, with noise of the
    batch's number.

    Args:
        optics: what forms the images. scenes: frames by number.
        config: of the reference reader.
    """
    pixels, vergence, slip = [], [], []
    pitch = torch.tensor(config.pitch_um, dtype=torch.float64)
    for number in range(count // BATCH):
        batch = scenes.batch(number, BATCH)
        light = sensor_irradiance(batch.frames, optics)
        noise = torch.Generator().manual_seed(7_000_003 * (config.seed + 1) + number)
        pixels.append(
            read_out(
                light,
                config.pitch_um,
                pitch,
                config.sensor,
                generator=noise,
                exact=False,
            )
        )
        vergence.append(
            blur.window_vergence(depth_um(batch.frames, margin=config.margin))
        )
        slip.append(batch.slip_mm)
    return LensFrames(torch.cat(pixels), torch.cat(vergence), torch.cat(slip))


def _learn_depth(
    made: ReferenceReader, learn: LensFrames, *, passes: int = 4, batch: int = 64
) -> None:
    for rows in _steps(
        made.branch, len(learn.pixels), passes, batch, rate=3e-3, decay=0.01
    ):
        predicted, _ = made.branch(learn.pixels[rows])
        losses.depth_loss(predicted, learn.vergence[rows]).backward()  # type: ignore[no-untyped-call]


def _learn_slip(
    made: ReferenceReader, learn: LensFrames, *, passes: int = 12, batch: int = 128
) -> None:
    features = _features(made, learn)
    truth = learn.slip_mm / SLIP_SCALE_MM
    for rows in _steps(made.slip, len(features), passes, batch, rate=2e-3, decay=0.03):
        found = made.slip(features[rows])
        miss = found[:, :3] - truth[rows]
        spread = found[:, 3:].clamp(-4, 2)
        uncertainty = (
            0.5 * miss.detach() ** 2 * torch.exp(-2 * spread) + spread
        ).mean()
        loss = F.smooth_l1_loss(found[:, :3], truth[rows], beta=0.3) + 0.1 * uncertainty
        loss.backward()


def _steps(
    part: nn.Module, count: int, passes: int, batch: int, *, rate: float, decay: float
) -> Iterator[Tensor]:
    """Rows of every batch; a step of AdamW on one rising and falling rate after each."""
    part.train()
    optimiser = torch.optim.AdamW(part.parameters(), lr=rate, weight_decay=decay)
    total = passes * max(count // batch, 1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=total)
    for _ in range(passes):
        order = torch.randperm(count)
        for k in range(max(count // batch, 1)):
            optimiser.zero_grad(set_to_none=True)
            yield order[k * batch : (k + 1) * batch]
            optimiser.step()
            schedule.step()
    part.eval()


@torch.no_grad()
def _features(made: ReferenceReader, seen: LensFrames) -> Tensor:
    parts = [
        made.branch(seen.pixels[i : i + 256])[1]
        for i in range(0, len(seen.pixels), 256)
    ]
    return torch.cat(parts)


@torch.no_grad()
def _judge(
    made: ReferenceReader, spare: LensFrames, judged: LensFrames, image_error: float
) -> ReaderResult:
    def slip(seen: LensFrames) -> tuple[Tensor, Tensor]:
        found = made.slip(_features(made, seen))
        return (found[:, :3] * SLIP_SCALE_MM - seen.slip_mm).abs(), found[:, 5].clamp(
            -4, 2
        ).exp() * SLIP_SCALE_MM[2]

    error, spread = slip(spare)
    ratio = (error[:, 2] / spread).sort().values
    reach = float(ratio[min(math.ceil(SHARE * (len(ratio) + 1)), len(ratio)) - 1])
    error, spread = slip(judged)
    predicted = torch.cat(
        [
            made.branch(judged.pixels[i : i + 256])[0]
            for i in range(0, len(judged.pixels), 256)
        ]
    )
    truth = blur.depth_mm(judged.vergence)
    depth = blur.depth_mm(predicted[:, 0])
    window = (depth - truth).abs()
    trusted = window.flatten()[
        (depth**2 * predicted[:, 1].exp()).flatten().argsort()[: window.numel() // 2]
    ]
    guess = float((truth - truth.median()).abs().mean())
    inside = float((error[:, 2] <= reach * spread).float().mean())
    wide = float((reach * spread).mean())
    lateral, windows = error[:, :2].mean(1), window.mean((1, 2))
    return ReaderResult(
        error[:, 2],
        lateral,
        windows,
        guess,
        inside,
        wide,
        image_error,
        float(trusted.mean()),
    )


def reader_table(found: dict[str, ReaderResult], config: ReaderConfig) -> Table:
    """A row a lens.

    Args:
        found: result by name of the lens. config: of the reference reader.
    """
    light = f"{config.fwhm_nm:g} nm of light" if config.fwhm_nm else "one wavelength"
    caption = (
        f"Read by the reference reader: {config.frames} frames of {config.pixels} pixels of {config.pitch_um:g} µm, "
        f"{config.electrons:g} e, {light}, whole field; 95 % interval over {config.test} test frames."
    )
    head = (
        "lens",
        "axial / mm",
        "90 % interval",
        "covers",
        "lateral / mm",
        "windows / mm (guess)",
        "image error",
    )
    rows = []
    for name, one in found.items():
        v = one.values()
        axial = (
            f"{v['axial_mm']:.2f} [{v['axial_low_mm']:.2f}, {v['axial_high_mm']:.2f}]"
        )
        wide = f"±{v['interval_mm']:.2f} mm"
        covered = f"{100 * v['covered']:.0f} %"
        windows = f"{v['window_mm']:.2f} ({v['guess_mm']:.2f})"
        rows.append(
            (
                name,
                axial,
                wide,
                covered,
                f"{v['lateral_mm']:.2f}",
                windows,
                f"{v['image_error']:.3f}",
            )
        )
    return Table(head, rows, caption)


def judge_lenses(
    lenses: dict[str, Lens], config: ReaderConfig
) -> Iterator[tuple[str, ReaderResult]]:
    """Every lens by name, on the same scenes.

    Args:
        config: of the reference reader.

    Raises:
        ConfigError: lenses of different sensor distances (through films: reduced),
            whose frames differ in size.
    """
    distances = {name: lens.reduced_um for name, lens in lenses.items()}
    if max(distances.values()) > min(distances.values()) * 1.001:
        raise ConfigError(
            f"lenses of different sensor distances {distances} um: compare lenses of one distance"
        )
    seen = render_scenes(config, sensor_distance_um=next(iter(distances.values())))
    near, far = config.depths_mm
    about = {"fwhm_nm": config.fwhm_nm, "tolerance": config.tolerance}
    for name, lens in lenses.items():
        yield (
            name,
            train_reader(
                lens_imager(lens, config.camera, (near * 1e3, far * 1e3), **about),
                seen,
                config,
            ),
        )


__all__ = [
    "ReaderConfig",
    "ReaderResult",
    "ReferenceReader",
    "judge_lenses",
    "reader_table",
    "render_scenes",
    "train_reader",
]
