"""What each of two processes does, and one alone: ``torchrun --nproc-per-node=2 -m
...of_two FOLDER``.
"""

import os
import sys
from pathlib import Path

import torch

from codesign.batches import parallel
from codesign.batches.pool import PoolScenes, render_pool
from codesign.batches.scenes import EyeScenes, SceneConfig
from codesign.batches.surface_frames import EyePose, FrameBatch
from codesign.network.architecture import Architecture, SearchSpace
from codesign.optics.stack import OpticsConfig
from codesign.train import evolution
from codesign.train import trainer as training
from codesign.train.evolution import EvolutionSettings
from codesign.train.trainer import InnerConfig, LearningRateSchedule, Trainer
from metalens.core.errors import TrainingError
from metalens.image.scene import Frames
from metalens.image.sensor import Sensor

ITEMS = [3, 4, 5, 6, 7]


def trained():
    """Gradient of the lens, weights of the first layer and the loss after one step of
    four frames.
    """
    scenes = EyeScenes(SceneConfig(pixels=48, margin=8), 24.0, 2000.0, 3)
    optics = OpticsConfig(
        aperture_mm=0.4,
        depth_count=4,
        sample_um=24.0,
        window_samples=9,
        polynomials=6,
        image="uniform",
    )
    space = SearchSpace(widths=(0.25,), depths=(2,), expansions=(3,), kernels=(3,))
    config = InnerConfig(
        steps=1,
        batch=4,
        seed=1,
        optics=LearningRateSchedule(0.02, 0.0, 1.0),
        optics_weight=0.0,
    )
    member = Architecture((2,) * 5, (3,) * 10, (3,) * 10, 0.25, 1.0)
    made = training.make_model(optics, pitch_um=24.0, seed=1, space=space)
    trainer = Trainer(
        config,
        optics,
        Sensor(24.0),
        PoolScenes(render_pool(scenes, 12), 8, 0.2, 1),
        made,
        architecture=member,
    )
    records = list(trainer.run())
    return made.coefficients_rad.grad, made.net.stem.weight.detach(), records[-1].loss


def searched():
    """A search by a made-up error, as text, and how many candidates this process
    judged.
    """
    judged = []

    def error(architecture):
        judged.append(architecture)
        return sum(architecture.kernels) / 7 + abs(architecture.width - 1.0)

    history = evolution.search(
        SearchSpace(),
        EvolutionSettings(8, 3, 40, together=4),
        error,
        lambda a: 1e6 * sum(a.depths),
        budget=1e9,
        seed=5,
    )
    return evolution.state_to_json(evolution.EvolutionState(history)), len(judged)


def batch(count):
    """Frames with their pose, no two numbers alike."""
    draw = torch.Generator().manual_seed(9)
    frames = Frames(*(torch.rand(count, 2, 4, 4, generator=draw) for _ in range(3)))
    pose = EyePose(*(torch.rand(count, 2, generator=draw) for _ in EyePose.__slots__))
    return FrameBatch(
        frames,
        torch.rand(count, 4, 4, generator=draw),
        torch.rand(count, 3, generator=draw),
        pose,
    )


def refused():
    """What a batch of five is told."""
    try:
        parallel.batch_share(batch(5))
    except TrainingError as error:
        return str(error)


def main(folder: Path) -> None:
    """All of it; then the second process goes, and the first is told."""
    torch.set_num_threads(1)
    parallel.join_processes()
    rank, done = parallel.process_rank(), []
    found = {
        "trained": trained(),
        "searched": searched(),
        "part": parallel.batch_share(batch(6)),
        "refused": refused(),
        "mean": parallel.mean_of(torch.tensor([1.5 + rank, -2.0 * rank])).tolist(),
        "each": parallel.share_work(
            lambda item: done.append(item) or 10.0 * item, ITEMS
        ),
        "done": done,
    }
    parallel.wait_for_all()
    if rank == 0:
        try:
            while True:
                parallel.mean_of(torch.ones(1))
        except TrainingError as error:
            found["lost"] = str(error)
    torch.save(found, folder / f"{rank}.pt")
    os._exit(0)  # the others are not waited for


if __name__ == "__main__":
    main(Path(sys.argv[1]))
