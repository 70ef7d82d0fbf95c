"""The planner against what its plans achieve: twenty random goals, and what the planned
runs cost beside the finest.
"""

import math

import numpy as np
import torch

from benchmarks import Row, fastest
from codesign.budget import plan, task
from codesign.budget.plan import Chain, Choice, PlanConfig, TrueChoice
from codesign.budget.task import TaskSetting

GOALS = 20
CONFIG = PlanConfig(
    aperture_mm=0.3,
    led_fwhm_nm=30.0,
    stacks=20,
    frames=1000,
    task=TaskSetting(scenes=4),
)


def rows() -> list[Row]:
    """Predicted against achieved gaze error over random goals between the loosest and
    the finest settings' errors.
    """
    chain = Chain(CONFIG)
    measured = plan.pilot(chain)
    loosest = plan.choose(measured, math.inf, CONFIG).predicted_rad
    random = np.random.default_rng(2)
    goals = loosest * 10 ** random.uniform(-2.0, 0.0, GOALS)
    plans = [plan.choose(measured, float(goal), CONFIG) for goal in goals]
    truths: dict[float, torch.Tensor] = {}
    found: dict[Choice | TrueChoice, tuple[float, float]] = {}
    for each in plans:
        choice = each.choice
        if choice.diameter_step_nm not in truths:
            truths[choice.diameter_step_nm] = _reality(chain, choice.diameter_step_nm)
        if choice not in found:
            error = _achieved(chain, choice, truths[choice.diameter_step_nm])
            found[choice] = error, _seconds(chain, choice)
    finest = _seconds(chain, chain.finest)
    ratios = np.array([p.predicted_rad / found[p.choice][0] for p in plans])
    costs = np.array([finest / found[p.choice][1] for p in plans])
    within = int(((ratios <= 2) & (ratios >= 0.5)).sum())
    seconds = float(np.median([found[p.choice][1] for p in plans]))
    return [
        Row(
            f"{GOALS} random goals of true images, {len(found)} different plans",
            "metalens plan",
            seconds,
            float(np.exp(np.abs(np.log(ratios)).max())),
            "predicted over achieved gaze error, the worst factor",
            goal=f"within 2x for all: {within} of {GOALS}",
        ),
        Row("the same", "everything at its finest", finest, math.nan, "the reference",
            goal=f">= 3x cheaper: least {costs.min():.1f}x, median {np.median(costs):.1f}x"),
        Row("pilot", "metalens plan", measured.spent_seconds, math.nan, "no error"),
    ]  # fmt: skip


def _achieved(chain: Chain, choice: Choice | TrueChoice, truth: torch.Tensor) -> float:
    """Gaze error, rad, of the estimator that believes in the optics of ``choice``, on
    images of :func:`_reality`.
    """
    optics = chain.optics(chain.table(choice.library_tolerance), choice.imaging)
    return task.gaze_rms(chain.read(truth, optics))


def _reality(chain: Chain, diameter_step_nm: float) -> torch.Tensor:
    """(scenes, pixels) of the eyes through the finest optics, pillars as the mask has
    them.
    """
    exact = chain.table(chain.finest.library_tolerance)
    return chain.electrons(
        chain.optics(
            chain.aperture.rounded(exact, diameter_step_nm * 1e-3), chain.finest.imaging
        )
    )


def _seconds(chain: Chain, choice: Choice | TrueChoice) -> float:
    """Time of the run with these settings: library, stacks, images, each measured."""
    table = chain.table(choice.library_tolerance)
    library = chain.library(choice.library_tolerance)[1]
    optics = chain.optics(table, choice.imaging)
    stack = fastest(lambda: chain.optics(table, choice.imaging))
    image = fastest(lambda: chain.electrons(optics)) / CONFIG.task.scenes
    return library + CONFIG.stacks * stack + CONFIG.frames * image
