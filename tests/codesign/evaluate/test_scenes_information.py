"""Fisher matrix of rendered scenes: of differences to the anchor, all in its mean
light.
"""

import numpy as np
import pytest
import torch

from codesign.evaluate import scenes

draw = np.random.default_rng(8)


def test_gaze_and_slip_count_against_the_anchor_in_its_mean_light():
    """The brightness that gaze and slip add is signal: every image is divided by the
    anchor's mean, not by its own.
    """
    anchor, gaze, slip = (
        torch.from_numpy(draw.uniform(0.5, 1.5, (2, 4, 5)) * k) for k in (3.0, 4.0, 5.0)
    )
    found = scenes.SceneObjective._fisher(None, [anchor, gaze, slip]).numpy()
    steps = []
    for image in (gaze, slip):
        parts = [
            (image[k] - anchor[k]).numpy() / anchor[k].numpy().mean() for k in range(2)
        ]
        steps.append(np.concatenate([part.ravel() for part in parts]))
    want = [[a @ b for b in steps] for a in steps]
    assert found == pytest.approx(np.array(want), rel=1e-12)
