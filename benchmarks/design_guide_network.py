"""The elastic network in the place of the reference reader: the same test frames,
trained on frames seen once.

    frames of a seed → true image through a lens that stands → the network → slippage,
    windows' depths, pupil, gaze

Nothing but the lens differs between the runs of a seed: frames, noise, first weights
and their order are the seed's.
"""

from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.codesign_gaze import rendered
from benchmarks.codesign_study import CASES, DEPTH_ALONE, SPACE, architecture_of
from codesign.batches import EyeScenes, SceneConfig
from codesign.batches.scenes import TEST, TRAINING
from codesign.evaluate.reader import ReaderConfig
from codesign.gaze import bench as gaze_test
from codesign.network import blur
from codesign.network.supernet import recalibrate
from codesign.optics.stack import OpticsConfig
from codesign.train import Scenes, assess, inner
from codesign.train.formation import network_macs
from codesign.train.inner import InnerConfig, Schedule, Trainer

CASE = CASES["p18blur"]  # the study's network: its size, and frames a step
PEOPLE, EACH = 16, 40  # of the test of gaze, as the study has it


def read(
    optics: OpticsConfig, place: Tensor, judge: Scenes, config: ReaderConfig
) -> dict[str, float]:
    """What a network that is trained behind the lens ``place`` reads of the frames that
    judge it, and its gaze.
    """
    trainer = trained(optics, place, config)
    net, member = trainer.model.net, architecture_of(CASE)
    seen = assess.frames(trainer, judge, config.test // CASE.batch)
    answers = assess.predict(net, member, seen, trainer.inner)
    if answers.depth is None or seen.vergence is None:
        raise TypeError("a network that reads no depth of windows")
    slip = (answers.slip_mm - seen.slip_mm).abs()
    depth, truth = blur.depth_mm(answers.depth[:, 0]), blur.depth_mm(seen.vergence)
    window, sure = (
        (depth - truth).abs().flatten(),
        (depth**2 * answers.depth[:, 1].exp()).flatten().argsort(),
    )
    macs = network_macs(
        net, member, config.pixels * config.pitch_um, torch.tensor(config.pitch_um)
    )
    found = {
        "axial_mm": slip[:, 2].mean(), "lateral_mm": slip[:, :2].mean(), "window_mm": window.mean(),
        "guess_mm": (truth - truth.median()).abs().mean(), "trusted_mm": window[sure[: len(sure) // 2]].mean(),
        "iou": answers.iou.mean(), "mmacs": macs / 1e6,
    }  # fmt: skip
    return {name: float(value) for name, value in found.items()} | {
        "gaze_deg": gaze_deg(trainer, config)
    }


def trained(optics: OpticsConfig, place: Tensor, config: ReaderConfig) -> Trainer:
    """The trainer at the end, its network with the batch statistics of its lens."""
    scenes = scenes_of(config, TRAINING)
    settings = InnerConfig(
        steps=config.frames // CASE.batch,
        batch=CASE.batch,
        seed=config.seed,
        optics=Schedule(0.0),
        **DEPTH_ALONE,
    )
    made = inner.model(optics, pitch_um=config.pitch_um, seed=config.seed, space=SPACE)
    with torch.no_grad():
        made.coefficients_rad.copy_(place)
    trainer = Trainer(
        settings,
        optics,
        config.sensor,
        scenes,
        made,
        architecture=architecture_of(CASE),
    )
    for _ in trainer.run():
        pass
    seen = assess.frames(trainer, scenes, 256 // CASE.batch).frames
    recalibrate(
        made.net,
        architecture_of(CASE),
        [seen[i : i + 32] for i in range(0, len(seen), 32)],
    )
    return trainer


def scenes_of(config: ReaderConfig, stream: int) -> EyeScenes:
    """Frames of a stream of the seed, each rendered when asked for."""
    scenes, distance = (
        SceneConfig(pixels=config.pixels, margin=config.margin),
        OpticsConfig().sensor_distance_mm * 1e3,
    )
    return EyeScenes(scenes, config.pitch_um, distance, config.seed, stream)


def gaze_deg(trainer: Trainer, config: ReaderConfig) -> float:
    """Mean angle between found and true visual axis after a personal calibration, over
    people of the seed.
    """
    test = gaze_test.people(scenes_of(config, TEST), PEOPLE, EACH, seed=config.seed + 5)
    shown = replace(rendered(test), margin=config.margin)
    seen = assess.frames(trainer, shown, len(shown.batches))
    answers = assess.predict(
        trainer.model.net, architecture_of(CASE), seen, trainer.inner
    )
    return gaze_test.gaze_errors(
        test, gaze_test.read_of(test, answers.centre, answers.slip_mm)
    ).personal_deg
