"""A source of finite size is blurred from a picture that is truer than what is asked of
the blur.
"""

from types import SimpleNamespace

import pytest
import torch

from metalens.psf import direction
from metalens.psf.extended import Extent


def test_the_point_s_picture_is_asked_for_more_strictly(monkeypatch):
    """The errors of point and blur add: the share of the point is less than the whole,
    for every depth alike.
    """
    asked = []
    light = torch.ones(1, 9, 9)

    def intensity(*_, tolerance, **__):
        asked.append(tolerance)
        return direction.IntensityResult(light, 1e-4, "so", torch.ones(1))

    monkeypatch.setattr(direction, "compute_intensity", intensity)
    monkeypatch.setattr(
        direction.extended, "blur_by_source", lambda light, *_: (light, 0.003)
    )

    def unlike(light, case, source, point):
        point(case)
        return 0.004

    monkeypatch.setattr(direction.extended, "shift_invariance_error", unlike)
    given = SimpleNamespace(
        shaded=lambda cases: (None, None),
        at=lambda case: case,
        weights=None,
        mixing=None,
    )
    case = SimpleNamespace(samples=(9, 9))
    made = direction._blurred(
        given, SimpleNamespace(case=case), case, Extent(size_um=40.0), 1e-2
    )[1]
    assert len(asked) == 2
    assert all(1e-2 / 20 <= one <= 1e-2 / 2 for one in asked)
    assert made.source == pytest.approx(0.005)
    assert made.error == 1e-4
