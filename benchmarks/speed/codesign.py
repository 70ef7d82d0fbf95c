"""Co-design: frames a second by multiply-accumulates and image, what of a step is data,
the error of every shortcut.
"""

import math
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks import Row, fastest
from benchmarks.peers import mobilenet_v3
from codesign.batches import pool
from codesign.batches.pool import PoolScenes
from codesign.batches.scenes import EyeScenes, SceneConfig
from codesign.batches.surface_frames import depth_um, flatten_layers, sensor_irradiance
from codesign.network import architecture, blur, cost
from codesign.network.architecture import Architecture, SearchSpace
from codesign.network.supernet import Supernet
from codesign.optics import image_formation
from codesign.optics import stack as optics
from codesign.optics.stack import OpticsConfig
from codesign.train import make_model
from codesign.train.imaging import read_out
from codesign.train.trainer import InnerConfig, LearningRateSchedule, Trainer
from metalens.image import sensor as camera
from metalens.image.pupil import psf
from metalens.image.sensor import Sensor
from tests.codesign.optics.test_optics import pupil_phase, samples_fine

NONE, BATCH = float("nan"), 32
SCENES = EyeScenes(SceneConfig(), 9.0, 2000.0, 0)
OPTICS = OpticsConfig(focus_mm=33.0, depth_count=20, image="uniform")
TRUE = replace(OPTICS, image="true", fwhm_nm=30.0)  # over ±16 degrees and their corners
SENSOR = Sensor(9.0, 9.0, 2000.0, 0.0, 4000.0, 5.0, 10)
SPACE = SearchSpace(
    widths=(0.25, 0.5, 0.75),
    depths=(2, 3),
    expansions=(3, 4),
    kernels=(3, 5),
    resolution=(0.5, 1.0),
)
SIZES = ((0.25, 2), (0.5, 2), (0.5, 3), (0.75, 3))  # width, depth
ASKED = {"uniform": "asked 50 % at 20 MMACs", "true": "asked 25 %, 150 frames/s"}


def rows() -> list[Row]:
    """Rows of this topic."""
    threads = torch.get_num_threads()
    made = pool.render_pool(SCENES, 2 * BATCH)
    trained = [
        row for optics in (OPTICS, TRUE) for row in _training(threads, made, optics)
    ]
    return [
        *_counts(),
        *_optics(threads),
        *_stages(threads, made),
        *trained,
        *_compiled(threads),
    ]


def _member(width: float, depth: int) -> Architecture:
    return Architecture(
        (depth,) * 5, (5,) * SPACE.slots, (3,) * SPACE.slots, width, 1.0
    )


def _counts() -> list[Row]:
    generator = np.random.default_rng(0)
    space = SearchSpace()
    worst = 0.0
    net = Supernet(space).eval()
    for _ in range(40):
        member = architecture.sample_architecture(space, generator)
        size = round(128 * member.resolution)
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            net(torch.zeros(1, 1, size, size), replace(member, resolution=1.0))
        worst = max(
            worst,
            abs(
                float(cost.network_cost(space, member).at(size))
                * 2
                / counter.get_total_flops()
                - 1
            ),
        )
    seconds = fastest(lambda: cost.macs(member, 9.0, window_um=1152.0))
    out = [
        Row(
            "MACs of 40 random subnets",
            "Eq. 9",
            seconds,
            worst,
            "PyTorch's flop counter",
            goal="asked 1e-3",
        )
    ]
    for variant, published in (("small", 56.5e6), ("large", 216.6e6)):
        error = abs(mobilenet_v3.counted(variant) / published - 1)
        out.append(
            Row(
                f"MobileNetV3 {variant} at 224²",
                "Eq. 9",
                NONE,
                error,
                "56.5 / 216.6 M as published",
            )
        )
    member = _member(0.5, 2)
    pitch = torch.tensor(9.25, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(
        cost.macs(member, pitch, window_um=1152.0, space=SPACE), pitch
    )
    step = 1e-5
    ahead, behind = (
        float(cost.macs(member, 9.25 + s, window_um=1152.0, space=SPACE))
        for s in (step, -step)
    )
    error = abs(float(slope) / ((ahead - behind) / (2 * step)) - 1)
    return [
        *out,
        Row(
            "d MACs / d pitch",
            "autograd",
            NONE,
            error,
            "central difference",
            goal="asked 1e-4",
        ),
    ]


def _optics(threads: int) -> list[Row]:
    generator = torch.Generator().manual_seed(0)
    phase = (
        0.5 * torch.randn(35, generator=generator, dtype=torch.float64)
    ).requires_grad_()
    weight = torch.randn(20, 33, 33, generator=generator)

    def gradient() -> torch.Tensor:
        return torch.autograd.grad(
            (optics.lens_psf_stack(OPTICS, phase).intensity * weight).sum(), phase
        )[0]

    quick = optics.lens_psf_stack(OPTICS, phase).intensity.detach()
    error = float((quick - _slow_stack(phase.detach())).norm() / quick.norm())
    way = torch.randn(35, generator=generator, dtype=torch.float64)
    step = 1e-3
    with torch.no_grad():
        ends = [
            (
                optics.lens_psf_stack(OPTICS, phase + s * way).intensity.double()
                * weight
            ).sum()
            for s in (step, -step)
        ]
    slope = float(ends[0] - ends[1]) / (2 * step)
    wrong = abs(float(gradient() @ way) / slope - 1)
    case = "20 PSFs of 33² samples, 35 polynomials"
    forward = fastest(lambda: optics.lens_psf_stack(OPTICS, phase.detach()))
    return [
        Row(
            case,
            "pupil autocorrelation",
            forward,
            error,
            "fine intensity, low-passed: relative L2",
            threads,
        ),
        Row(
            case,
            "with gradient",
            fastest(gradient),
            wrong,
            "central difference along a direction",
            threads,
        ),
    ]


def _slow_stack(phase: torch.Tensor) -> torch.Tensor:
    """The same light from the finely sampled intensity, integrated over samples and
    low-passed by plain sums.
    """
    fine = samples_fine(OPTICS)
    size = OPTICS.window_samples
    step = OPTICS.sample_um
    bright = psf(
        pupil_phase(OPTICS, phase), OPTICS.pupil, depths_um=OPTICS.depths_um,
        focus_um=OPTICS.focus_mm * 1e3, sample_um=step / fine, samples=size * fine,
    )  # fmt: skip
    period = OPTICS.pupil.period_um
    edge = period / (
        2 * step
    )  # the harmonic there counts by the part of it that lies below
    number = torch.arange(
        -math.floor(edge + 0.5), math.floor(edge + 0.5) + 1, dtype=torch.float64
    )
    frequency = number / period
    share = (edge + 0.5 - number.abs()).clamp(0, 1)
    from_x = (
        (torch.arange(size * fine, dtype=torch.float64) - (size * fine - 1) / 2)
        * step
        / fine
    )
    to_x = (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * step
    waves = torch.cos(2 * math.pi * frequency * (to_x[:, None, None] - from_x[:, None]))
    taps = (share * torch.sinc(frequency * step) * waves).sum(-1) * step / period
    return (taps @ bright.double() @ taps.mT).float()


def _stages(threads: int, made: pool.FramePool) -> list[Row]:
    lens = optics.stack_imager(
        OPTICS, optics.lens_psf_stack(OPTICS, torch.zeros(35)), 160, margin=16
    )
    sheets = SCENES.rendered(0, 8).frames
    scale = SCENES.states(0, 8).scale
    exact = sensor_irradiance(sheets, lens)
    quick = sensor_irradiance(flatten_layers(sheets, scale), lens)
    error = float(
        (quick - exact).norm() / (exact - exact.mean((1, 2), keepdim=True)).norm()
    )
    batch = PoolScenes(made, 16, 0.2, 0).batch(0, BATCH)
    light = sensor_irradiance(batch.frames, lens)
    pitch = torch.tensor(9.0, dtype=torch.float64)
    noise = torch.Generator().manual_seed(0)

    def sensor(exact: bool) -> torch.Tensor:
        return read_out(light, 9.0, pitch, SENSOR, generator=noise, exact=exact)

    render = fastest(lambda: SCENES.rendered(1, 8)) / 8
    one, two = (
        fastest(partial(sensor_irradiance, f, lens)) / n
        for f, n in ((batch.frames, BATCH), (sheets, 8))
    )
    fast, slow = (fastest(partial(sensor, e)) / BATCH for e in (False, True))
    slope, slope_error = _pitch_slope(light)
    return [
        Row(
            "a frame of 160²: render",
            "once for a pool",
            render,
            NONE,
            "see topic scene",
            threads,
            goal=_rate(render),
        ),
        Row(
            "a frame: optics",
            "two sheets",
            two,
            0.0,
            "itself",
            threads,
            goal=_rate(two),
        ),
        Row(
            "a frame: optics",
            "flat",
            one,
            error,
            "two sheets, of the contrast",
            threads,
            goal=_rate(one),
        ),
        Row(
            "a frame: sensor", "Poisson", slow, 0.0, "itself", threads, goal=_rate(slow)
        ),
        Row(
            "a frame: sensor",
            "normal",
            fast,
            NONE,
            "mean and variance are exact",
            threads,
            goal=_rate(fast),
        ),
        Row(
            "d frame / d pitch",
            "autograd",
            slope,
            slope_error,
            "central difference, asked 1e-4",
            threads,
        ),
    ]


def _pitch_slope(light: torch.Tensor) -> tuple[float, float]:
    """Seconds a frame of the derivative of a weighted sum of pixels in their box's
    width, and its relative error.
    """
    light = light.double()

    def value(pitch_um: torch.Tensor) -> torch.Tensor:
        pixels = camera.mean_electrons(
            light, 9.0, sensor=SENSOR, pitch_um=pitch_um, grid_um=14.0
        )
        return (pixels * torch.arange(pixels.numel()).reshape(pixels.shape).cos()).sum()

    def slope() -> float:
        pitch = torch.tensor(14.0, dtype=torch.float64, requires_grad=True)
        return float(torch.autograd.grad(value(pitch), pitch)[0])

    ahead, behind = (
        float(value(torch.tensor(14.0 + s, dtype=torch.float64))) for s in (1e-4, -1e-4)
    )
    return fastest(slope) / len(light), abs(slope() / ((ahead - behind) / 2e-4) - 1)


def _rate(seconds: float) -> str:
    return f"{1 / seconds:.0f} frames/s"


def _trainer(
    made: pool.FramePool, member: Architecture | None, of: OpticsConfig, *, live: bool
) -> Trainer:
    lens, pitch = (
        LearningRateSchedule(rate if live else 0.0, 0.0, 0.9) for rate in (0.02, 0.005)
    )
    settings = InnerConfig(
        steps=10_000, batch=BATCH, optics=lens, pitch=pitch, optics_weight=0.0
    )
    fresh = make_model(of, pitch_um=9.0, seed=0, space=SPACE)
    return Trainer(
        settings, of, SENSOR, PoolScenes(made, 16, 0.2, 0), fresh, architecture=member
    )


def _training(threads: int, made: pool.FramePool, of: OpticsConfig) -> list[Row]:
    """Whole steps, lens and pitch fixed and moving; the share of the fixed one's that
    its frames take.
    """
    out = []
    data, anew = _data(made, of), _anew(of)
    for width, depth in SIZES:
        member = _member(width, depth)
        macs = float(cost.macs(member, 9.0, window_um=1152.0, space=SPACE)) / 1e6
        frozen, moving = (
            _trainer(made, member, of, live=live).run() for live in (False, True)
        )
        fixed, joint = (
            fastest(partial(next, steps), repeats=4) / BATCH
            for steps in (frozen, moving)
        )
        joint += anew
        case = f"{macs:.1f} MMACs, {of.image} image"
        goal = f"{_rate(fixed)}; data {data / fixed:.0%} of a step"
        if of.image == "uniform":
            forward = _forward(member)
            out.append(
                Row(
                    f"{macs:.1f} MMACs",
                    "network, forward",
                    forward,
                    NONE,
                    "-",
                    threads,
                    goal=_rate(forward),
                )
            )
        out += [
            Row(
                case,
                "training step, lens fixed",
                fixed,
                NONE,
                "-",
                threads,
                goal=f"{goal}; {ASKED[of.image]}",
            ),
            Row(
                case,
                "training step, lens and pitch moving",
                joint,
                NONE,
                "-",
                threads,
                goal=_rate(joint),
            ),
        ]
    return out


def _data(made: pool.FramePool, of: OpticsConfig) -> float:
    """Seconds a frame of what a network is trained on: drawn from the pool, imaged,
    read out, with its depths.
    """
    scenes = PoolScenes(made, 16, 0.2, 0)
    pitch = torch.tensor(9.0, dtype=torch.float64)
    noise = torch.Generator()
    lens = image_formation.make_imager(
        of, torch.zeros(35, dtype=torch.float64), 160, margin=16
    )

    @torch.no_grad()
    def work() -> None:
        batch = scenes.batch(0, BATCH)
        light = sensor_irradiance(batch.frames, lens)
        blur.window_vergence(depth_um(batch.frames, margin=16))
        read_out(light, 9.0, pitch, SENSOR, generator=noise.manual_seed(0), exact=False)

    return fastest(work) / BATCH


def _anew(of: OpticsConfig) -> float:
    """Seconds a frame of forming the image of a lens that moved anew, every so many
    steps; none of one PSF a depth,
    which is formed in every step."""
    if of.image == "uniform":
        return 0.0
    places = iter(
        torch.full((35,), 0.01 * n, dtype=torch.float64) for n in range(1, 9)
    )  # none is formed twice
    seconds = fastest(
        lambda: image_formation.make_imager(of, next(places), 160, margin=16), repeats=2
    )
    return seconds / (InnerConfig().refresh * BATCH)


def _forward(member: Architecture) -> float:
    """Seconds a frame of a network's forward pass as it trains."""
    net = make_model(OPTICS, pitch_um=9.0, seed=0, space=SPACE).net.train()
    frames = torch.randn(BATCH, 1, 128, 128).contiguous(
        memory_format=torch.channels_last
    )

    def look() -> None:
        with torch.no_grad():
            net(frames, member)

    return fastest(look, repeats=4) / BATCH


def _compiled(threads: int) -> list[Row]:
    """The network's forward pass through torch.compile, where a compiler is found."""
    if shutil.which("g++") is None:
        return [
            Row(
                "network compiled",
                "torch.compile",
                NONE,
                NONE,
                "no compiler found",
                threads,
            )
        ]
    member, frames = _member(0.5, 2), torch.randn(8, 1, 128, 128)
    net = make_model(OPTICS, pitch_um=9.0, seed=0, space=SPACE).net.eval()
    quick = torch.compile(lambda x: net(x, member).slip)
    with torch.no_grad():
        error = float((quick(frames) - net(frames, member).slip).abs().max())
        eager, compiled = (
            fastest(partial(f, frames), repeats=5) / 8
            for f in (lambda x: net(x, member).slip, quick)
        )
    return [
        Row(
            "17 MMACs, forward",
            "eager",
            eager,
            0.0,
            "itself",
            threads,
            goal=_rate(eager),
        ),
        Row(
            "17 MMACs, forward",
            "compiled",
            compiled,
            error,
            "eager, largest difference",
            threads,
            goal=_rate(compiled),
        ),
    ]
