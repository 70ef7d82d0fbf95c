"""Which lens lets a small network read depth: fixed lenses against lenses trained
together with the network.

    python -m benchmarks.codesign_study run --work DIR             # every run of the plan that has no line yet
    python -m benchmarks.codesign_study run --work DIR --only p18/hyper33/0
    python -m benchmarks.codesign_study retest --work DIR --only p9/hyper33/0     # as p9wide: on four times the frames
    python -m benchmarks.codesign_report --work DIR                # JSON, table and figures from the lines there are
    python -m benchmarks.codesign_report --work DIR --only p18blur # the JSON of some
    cases, beside that of the study

Every run draws the same number of frames from one pool, with the same network, noise
and schedule; the lens alone
differs. One JSON line a run, errors of every test frame beside it; a stopped study goes
on at its last 100 steps.
"""

import argparse
import json
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from benchmarks import keep_line, kept_lines
from codesign.batches import pool
from codesign.batches.pool import PoolScenes
from codesign.batches.scenes import TEST, TRAINING, EyeScenes, SceneConfig
from codesign.eye import dataset
from codesign.eye.population import States
from codesign.eye.renderer import render
from codesign.network.architecture import Architecture, Space
from codesign.network.baselines import Name
from codesign.network.supernet import recalibrate
from codesign.optics.stack import OpticsConfig, added_phase
from codesign.train import ambiguity, assess, checkpoint, inner
from codesign.train.depth_test import depth_response
from codesign.train.formation import network_macs
from codesign.train.inner import Batch, InnerConfig, Scenes, Schedule, Trainer
from metalens.ground.paths import source_path
from metalens.image.pupil import Field, coordinates
from metalens.image.scene import Frames
from metalens.image.sensor import Sensor

LINES = "runs.jsonl"
TESTED, WIDE = 512, 2048  # frames of either test, and of a retest
SCENES = SceneConfig(pixels=128, margin=16, pool=4096)
FREE = Schedule(0.02, 0.12, 0.8, clip=1.0)
SWIFT = Schedule(
    0.05, 0.12, 0.8, clip=1.0
)  # from focus 20 to 33 mm is 5 rad: all that 540 steps of FREE can go
RUSH = Schedule(0.15, 0.06, 0.85, clip=1.0)
DEPTH_ALONE = {
    "optics_weight": 0.0,
    "axis_weight": 0.0,
    "point_weight": 0.0,
}  # what is trained beside slip and mask
SPACE = Space(
    widths=(0.25, 0.5),
    depths=(2, 3),
    expansions=(3, 4),
    kernels=(3, 5),
    resolution=(0.5, 1.0),
)


@dataclass(frozen=True, slots=True)
class Case:
    """Conditions that all lenses of a comparison share.

    pitch_um: of the pixels. electrons: that a white object gives in a pixel of 9 um.
    steps: of ``batch`` frames.
    width, depth: of the elastic network, and blocks of each of its stages. network: it,
    or a baseline in its place.
    angle_deg: field angle of the frames. fresh: every frame is rendered anew, in place
    of a pool that is seen again.
    """

    pitch_um: float
    electrons: float = 2000.0
    steps: int = 800
    width: float = 0.5
    depth: int = 2
    network: Name = "supernet"
    angle_deg: float = 0.0
    batch: int = 32
    fresh: bool = False


CASES = {
    "p9": Case(9.0),
    "p18": Case(18.0),
    "p18blur": Case(18.0, steps=3200, width=0.25, depth=3, batch=8, fresh=True),
    "p18blur16": Case(18.0, steps=1600, width=0.25, depth=3, batch=16, fresh=True),
    "p18blurlong": Case(18.0, steps=9600, width=0.25, depth=3, batch=8, fresh=True),
    "p18long": Case(18.0, steps=2400),
    "p18dim": Case(18.0, electrons=100.0),
    "p9dim": Case(9.0, electrons=400.0),
    "p9field": Case(9.0, angle_deg=10.0),
    "p18small": Case(18.0, steps=2400, width=0.25),
    "p18nvgaze": Case(18.0, steps=2400, network="nvgaze"),
    "p18popovic": Case(18.0, steps=2400, network="popovic"),
    "p18de2gaze": Case(18.0, steps=2400, network="de2gaze"),
}


def optics_of(lens: str, *, angle_deg: float = 0.0) -> tuple[OpticsConfig, Schedule]:
    """Optics and their schedule.

    hyperF: fixed, focused at F mm. obliqueF: fixed, free of aberrations at F mm at the
    field angle (:func:`oblique`).
    helixN: fixed double helix of N zones. jointF, swiftF, rushF: trained from hyperF,
    at three learning rates of the
    phase. swiftobliqueF: trained from obliqueF. jointhelixN: trained from helixN.
    """
    kind, number = (
        lens.rstrip("0123456789"),
        float(lens.lstrip("abcdefghijklmnopqrstuvwxyz")),
    )
    fixed = OpticsConfig(
        polynomials=0, depth_count=20, angle_deg=angle_deg, image="uniform"
    )
    if kind == "hyper":
        return replace(fixed, focus_mm=number), Schedule(0.0)
    if kind == "oblique":
        return replace(fixed, polynomials=35, focus_mm=number), Schedule(0.0)
    if kind == "swiftoblique":
        return replace(fixed, polynomials=35, focus_mm=number), SWIFT
    if kind == "helix":
        return replace(fixed, zones=int(number)), Schedule(0.0)
    if kind == "joint":
        return replace(fixed, polynomials=35, focus_mm=number), FREE
    if kind == "swift":
        return replace(fixed, polynomials=35, focus_mm=number), SWIFT
    if kind == "rush":
        return replace(fixed, polynomials=35, focus_mm=number), RUSH
    if kind == "jointhelix":
        return replace(fixed, polynomials=35, zones=int(number)), FREE
    raise SystemExit(
        f"no lens {lens!r}: need hyperF, obliqueF, helixN, jointF, swiftF, rushF, swiftobliqueF or jointhelixN"
    )


def oblique(settings: OpticsConfig) -> torch.Tensor:
    """(polynomials,) that turn the hyperbolic lens into the one that images the chief
    ray's point without aberration.

    Paths from source and image point, less those of the hyperbolic lens, by least
    squares over the aperture; what 35
    polynomials leave of it at 10 degrees is 2e-5 rad rms.
    """
    pupil = settings.pupil
    x, y = coordinates(pupil)
    field = Field(math.radians(settings.angle_deg))
    (tx, ty), flat = field.tangents, (0.0, 0.0)
    ends = (
        ((-tx, -ty), 1 / pupil.sensor_distance_um),
        ((tx, ty), 1e-3 / settings.focus_mm),
    )
    paths = sum(
        source_path(x, y, slope, inverse) - source_path(x, y, flat, inverse)
        for slope, inverse in ends
    )
    return fitted(settings, -2 * math.pi / pupil.wavelength_um * torch.as_tensor(paths))


def fitted(settings: OpticsConfig, wanted_rad: torch.Tensor) -> torch.Tensor:
    """(polynomials,) nearest to a phase (nodes, nodes) over the aperture, a constant
    left free; by least squares.
    """
    axial = replace(settings, angle_deg=0.0)
    x, y = coordinates(axial.pupil)
    inside = torch.hypot(x, y) <= axial.pupil.radius_um
    unit = torch.eye(settings.polynomials, dtype=torch.float64)
    modes = torch.stack(
        [added_phase(axial, one)[inside] for one in unit]
        + [torch.ones_like(x)[inside]],
        1,
    )
    return torch.linalg.lstsq(modes, wanted_rad[inside][:, None]).solution[:-1, 0]


def architecture_of(case: Case) -> Architecture:
    """The network of all runs of a case: kernels of 5, expansion 3."""
    return Architecture(
        (case.depth,) * 5, (5,) * SPACE.slots, (3,) * SPACE.slots, case.width, 1.0
    )


def scenes_of(stream: int, seed: int = 0) -> EyeScenes:
    """Frames of a stream; those of one seed are the same for every run."""
    return EyeScenes(SCENES, 9.0, 2000.0, seed, stream)


def pool_of(work: Path) -> pool.Pool:
    """Training frames, rendered once."""
    path = work / "pool.h5"
    if not path.exists():
        pool.save(path, pool.fill(scenes_of(TRAINING), SCENES.pool))
    return pool.load(path)


@dataclass(frozen=True, eq=False, slots=True)
class Kept:
    """Test frames with both sheets, rendered once; see
    :class:`codesign.train.inner.Scenes`.
    """

    frames: Frames
    mask: torch.Tensor
    slip_mm: torch.Tensor
    stream: int
    margin: int = SCENES.margin

    def batch(self, step: int, size: int) -> Batch:
        """Frames of a step."""
        part = slice(step * size, (step + 1) * size)
        frames = Frames(*(getattr(self.frames, n)[part] for n in Frames.__slots__))
        return Batch(frames, self.mask[part], self.slip_mm[part])


def kept(work: Path, name: str, count: int) -> Kept:
    """``ambiguous`` or ``natural`` test frames."""
    path = work / (f"{name}.h5" if count == TESTED else f"{name}_{count}.h5")
    scenes = scenes_of(TEST)
    if not path.exists():
        states = (
            ambiguity.ambiguous(scenes, count // 2, 17).states
            if name == "ambiguous"
            else _natural(scenes, count)
        )
        dataset.write_shard(
            path, render(states, rig=scenes.rig, camera=scenes.camera), seed=17
        )
    frames, mask, labels = dataset.read_shard(path)
    inside = slice(SCENES.margin, mask.shape[-1] - SCENES.margin)
    return Kept(
        frames,
        mask[:, inside, inside],
        (labels["slip_um"] * 1e-3).float(),
        2 if name == "natural" else 3,
    )


def _natural(scenes: EyeScenes, count: int) -> States:
    states = scenes.states(0, count)
    return replace(states, scale=torch.ones_like(states.scale))


def train_one(
    work: Path, case: Case, lens: str, seed: int, *, kept_at: Path
) -> Trainer:
    """The trainer at the end of its run, with the batch statistics of the final lens;
    goes on from ``kept_at``.
    """
    optics, moving = optics_of(lens, angle_deg=case.angle_deg)
    settings = InnerConfig(
        steps=case.steps, batch=case.batch, seed=seed, optics=moving, **DEPTH_ALONE
    )
    scenes: Scenes = (
        scenes_of(TRAINING, seed)
        if case.fresh
        else PoolScenes(pool_of(work), SCENES.margin, SCENES.scale, seed)
    )
    made = inner.model(
        optics, pitch_um=case.pitch_um, seed=seed, space=SPACE, network=case.network
    )
    if "oblique" in lens:
        with torch.no_grad():
            made.coefficients_rad.copy_(oblique(optics))
    trainer = Trainer(
        settings,
        optics,
        sensor_of(case),
        scenes,
        made,
        architecture=architecture_of(case),
    )
    if kept_at.is_file():
        trainer.restore(checkpoint.load(kept_at, settings=settings))
    for record in trainer.run():
        if record.step % 100 == 0:
            print(
                f"{lens}/{seed} step {record.step}: task {record.task:.3f}, {record.skipped} skipped",
                flush=True,
            )
            checkpoint.save(kept_at, trainer.state(), settings=settings)
    seen = assess.frames(trainer, scenes, 256 // case.batch)
    recalibrate(
        made.net,
        architecture_of(case),
        [seen.frames[i : i + 32] for i in range(0, 256, 32)],
    )
    return trainer


def run_one(work: Path, name: str) -> dict[str, Any]:
    """Train and test one run of the plan; its line."""
    case_name, lens, seed = name.split("/")
    case = CASES[case_name]
    start = time.perf_counter()
    kept_at = stem(work, name).with_suffix(".checkpoint")
    trainer = train_one(work, case, lens, int(seed), kept_at=kept_at)
    seconds = time.perf_counter() - start
    net, architecture = trainer.model.net, architecture_of(case)
    frames = case.steps * trainer.inner.batch
    window_um = SCENES.pixels * trainer.optics.sample_um
    macs = float(
        network_macs(net, architecture, window_um, torch.tensor(case.pitch_um))
    )
    line: dict[str, Any] = {
        "run": name,
        "frames": frames,
        "mmacs": macs / 1e6,
        "seconds": seconds,
    }
    line |= tested(work, name, trainer, architecture, count=TESTED)
    response = depth_response(
        trainer,
        kept(work, "ambiguous", TESTED),
        net,
        architecture,
        batches=256 // case.batch,
    )
    line["depth_response"] = {
        "mm_per_mm": response.mean,
        "standard_error": response.standard_error,
    }
    line["skipped_steps"] = trainer.skipped
    line["coefficients_rad"] = [
        round(float(v), 4) for v in trainer.model.coefficients_rad.detach()
    ]
    save_file(
        {k: v.contiguous() for k, v in net.state_dict().items()},
        stem(work, name).with_suffix(".safetensors"),
    )
    kept_at.unlink(missing_ok=True)
    return line


def tested(
    work: Path, name: str, trainer: Trainer, architecture: Architecture, *, count: int
) -> dict[str, Any]:
    """Errors of a run on ``count`` frames of both tests; those of every frame go to a
    file of the run's name.
    """
    errors, line = {}, {}
    for test in ("ambiguous", "natural"):
        seen = assess.frames(
            trainer, kept(work, test, count), count // trainer.inner.batch
        )
        answers = assess.predict(trainer.model.net, architecture, seen, trainer.inner)
        error = (answers.slip_mm - seen.slip_mm).abs()
        errors[test] = error.numpy()
        line[test] = {"axial_mm": float(error[:, 2].mean()), "lateral_mm": float(error[:, :2].mean()),
                      "iou": float(answers.iou.mean())}  # fmt: skip
    path = stem(work, name).with_suffix(".npz")
    np.savez_compressed(path, ambiguous=errors["ambiguous"], natural=errors["natural"])
    return line


def restored(work: Path, line: dict[str, Any], scenes: Scenes) -> Trainer:
    """A run of the study as it ended, from its line and the weights beside it."""
    case_name, lens, _ = line["run"].split("/")
    case = CASES[case_name]
    optics, _ = optics_of(lens, angle_deg=case.angle_deg)
    made = inner.model(
        optics, pitch_um=case.pitch_um, seed=0, space=SPACE, network=case.network
    )
    made.net.load_state_dict(
        load_file(stem(work, line["run"]).with_suffix(".safetensors"))
    )
    with torch.no_grad():
        made.coefficients_rad.copy_(
            torch.tensor(line["coefficients_rad"], dtype=torch.float64)
        )
    return Trainer(InnerConfig(batch=case.batch), optics, sensor_of(case), scenes, made)


def sensor_of(case: Case) -> Sensor:
    """Pixels of a case."""
    return Sensor(case.pitch_um, 9.0, case.electrons, 0.0, 2 * case.electrons, 5.0, 10)


def retest(work: Path, only: list[str] | None) -> None:
    """Test runs whose weights are kept (of those, ``only``) on four times the frames:
    lines of the case ``...wide``.
    """
    for line in kept_lines(work / LINES):
        case, lens, seed = line["run"].split("/")
        name = f"{case}wide/{lens}/{seed}"
        wanted = (
            line["run"] in only
            if only
            else stem(work, line["run"]).with_suffix(".safetensors").is_file()
        )
        if wanted and name not in done(work):
            trainer = restored(work, line, kept(work, "natural", WIDE))
            found = tested(
                work, name, trainer, architecture_of(CASES[case]), count=WIDE
            )
            keep_line(work / LINES, line | {"run": name} | found)
            print(json.dumps({"run": name} | found), flush=True)


def stem(work: Path, name: str) -> Path:
    """Path of what belongs to a run, without its ending."""
    return work / name.replace("/", "-")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verb", choices=["run", "retest"])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    if options.verb == "retest":
        retest(options.work, options.only)
        return
    for name in options.only or PLAN:
        if name not in done(options.work):
            line = run_one(options.work, name)
            keep_line(options.work / LINES, line)
            print(
                json.dumps({k: v for k, v in line.items() if k != "coefficients_rad"}),
                flush=True,
            )


SCAN = (
    "hyper12",
    "hyper24",
    "hyper28",
    "hyper40",
    "hyper50",
    "helix1",
    "helix3",
)  # chooses focus and helix: one seed
LENSES = ("hyper33", "joint33", "swift20", "hyper20", "helix2", "swift33")
MAIN = ("hyper33", "swift33", "hyper20")
BASELINES = get_args(Name)[1:]
LONG = ("hyper33", "swift33", "hyper40", "swift40", "hyper20")
PLAN = [f"p18long/{lens}/{seed}" for seed in range(5) for lens in LONG]
PLAN += [f"p18long/{lens}/0" for lens in ("joint33", "rush33", "hyper28")]
PLAN += [f"p9/{lens}/{seed}" for seed in range(5) for lens in LENSES]
PLAN += [f"{case}/{lens}/0" for case in ("p9", "p18") for lens in SCAN]
PLAN += [f"p18/{lens}/{seed}" for seed in range(5) for lens in LENSES]
PLAN += [
    f"{case}/{lens}/{seed}"
    for case in ("p18blur", "p18blurlong")
    for seed in range(5)
    for lens in ("hyper40", "hyper33", "swift40")
]
PLAN += [f"p18dim/{lens}/0" for lens in ("hyper33", "joint33", "hyper20", "hyper28")]
PLAN += [
    f"{case}/{lens}/{seed}"
    for case in ("p9dim", "p18small")
    for seed in range(3)
    for lens in MAIN
]
PLAN += [
    f"p9field/{lens}/{seed}"
    for seed in range(2)
    for lens in (*MAIN, "oblique33", "swiftoblique33")
]
PLAN += [f"p9field/{lens}/0" for lens in ("hyper40", "hyper50")]
PLAN += [
    f"p18{network}/{lens}/{seed}"
    for network in BASELINES
    for seed in range(3)
    for lens in ("hyper33", "hyper20")
]


def done(work: Path) -> set[str]:
    """Runs that have a line."""
    return {line["run"] for line in kept_lines(work / LINES)}


if __name__ == "__main__":
    main()
