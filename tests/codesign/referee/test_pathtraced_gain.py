"""Traced light is counted in the renderer's unit: that of the lamp times the camera's gain."""

from types import SimpleNamespace

import numpy as np
import pytest

from codesign.eye import model
from codesign.referee import pathtraced


def test_light_is_multiplied_by_the_gain(monkeypatch):
    light = np.random.default_rng(1).uniform(0, 1, (4, 5, 3))
    p = np.zeros(model.COUNT)
    p[model.GAIN] = 1.7
    fake = SimpleNamespace(load_dict=lambda scene: scene, render=lambda scene, *, spp, seed: light + spp + 100 * seed)
    monkeypatch.setattr(pathtraced, "start", lambda: fake)
    monkeypatch.setattr(pathtraced, "_parameters", lambda *_: p)
    monkeypatch.setattr(pathtraced, "build", lambda *_, **__: {})
    monkeypatch.setattr(pathtraced, "_bank", lambda: None)
    found = pathtraced.trace(None, samples=6, seed=2)
    assert found == pytest.approx(1.7 * (light[..., 0] + 206), rel=1e-12)
