"""Newton steps that bring a pupil's centroid back, on a sensor that bends: as near as
was asked for, and nearer.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

from codesign.eye import dataset


@dataclass(frozen=True)
class Looking:
    """States of which nothing but the gaze is told."""

    gaze_rad: torch.Tensor


FAR = [[12.0, -7.0], [3.0, 20.0], [-16.0, 9.0]]
BESIDE = [[0.025, 0.025]]  # 0.035 px in all


@pytest.mark.parametrize(
    ("goal", "tolerance_px"), [(FAR, 0.1), (FAR, 0.02), (BESIDE, 0.1)]
)
def test_centroids_come_within_a_third_of_the_tolerance(
    monkeypatch, goal, tolerance_px
):
    """150 px a radian, bent by 60 px a radian²: a step from 25 px leaves about a pixel,
    the next a thousandth.
    """
    goal = torch.tensor(goal, dtype=torch.float64)
    seen = torch.ones(len(goal), dtype=torch.float64)

    def centroids(states, gaze, rig, camera):
        x, y = gaze.unbind(1)
        return torch.stack(
            [150 * x + 20 * y + 60 * x * y, 140 * y - 10 * x + 60 * x * x], 1
        ), seen

    monkeypatch.setattr(dataset, "_centroids", centroids)
    labels = SimpleNamespace(centroid_px=goal, visible=seen)
    monkeypatch.setattr(
        dataset, "render", lambda *_, **__: SimpleNamespace(labels=labels)
    )
    start = Looking(torch.zeros(len(goal), 2, dtype=torch.float64))
    found, distance, good = dataset._returned(
        start, start, rig=None, camera=None, tolerance_px=tolerance_px
    )
    assert float(distance.max()) < 0.3 * tolerance_px
    assert good.all()
    here = centroids(None, found.gaze_rad, None, None)[0]
    assert (here - goal).norm(dim=1).numpy() == pytest.approx(
        distance.numpy(), abs=1e-12
    )
