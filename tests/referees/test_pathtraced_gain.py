"""Traced light is counted in the renderer's unit: that of the lamp times the camera's
gain.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from codesign.eye import model, population
from codesign.eye.renderer import PinholeCamera
from tests.referees import pathtraced


def test_light_is_multiplied_by_the_gain(monkeypatch):
    light = np.random.default_rng(1).uniform(0, 1, (4, 5, 3))
    p = np.zeros(model.COUNT)
    p[model.GAIN] = 1.7
    fake = SimpleNamespace(
        load_dict=lambda scene: scene,
        render=lambda scene, *, spp, seed: light + spp + 100 * seed,
    )
    monkeypatch.setattr(pathtraced, "start", lambda: fake)
    monkeypatch.setattr(pathtraced, "_parameters", lambda *_: p)
    monkeypatch.setattr(pathtraced, "build", lambda *_, **__: {})
    monkeypatch.setattr(pathtraced, "_bank", lambda: None)
    found = pathtraced.trace(None, samples=6, seed=2)
    assert found == pytest.approx(1.7 * (light[..., 0] + 206), rel=1e-12)


def test_paths_are_shared_by_two_halves_of_their_own_seeds(monkeypatch):
    """Of 7 paths a pixel each half has 3, and 6 are told."""
    asked = []

    def trace(state, *, rig, camera, samples, seed):
        asked.append((samples, seed))
        return np.full((camera.pixels, camera.pixels), 1.0 + seed)

    monkeypatch.setattr(
        pathtraced, "start", lambda: SimpleNamespace(variant=lambda: "none")
    )
    monkeypatch.setattr(pathtraced, "trace", trace)
    made = pathtraced.compare(
        population.draw_states(1, 5), camera=PinholeCamera(16, 90.0), samples=7
    )
    assert asked == [(3, 0), (3, 1)]
    assert (made.samples, made.variant) == (6, "none")
    assert made.traced == pytest.approx(np.full((16, 16), 1.5))
