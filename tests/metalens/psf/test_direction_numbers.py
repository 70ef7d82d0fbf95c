"""What a direction's light loses at the faces behind the lens, by hand."""

import math

import pytest

from metalens.lens import Media
from metalens.propagate import PropagationCase
from metalens.psf import direction

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900),
    (14.0, -8.5),
    0.6,
    (9, 11),
)


def test_faces_let_through_what_fresnel_has_for_the_chief_ray():
    """From a gel of 1.37 into glass of 1.52, light from (0.21, -0.13) in air: mean of
    both polarisations.
    """
    behind = Media((1.37, 1.52), (40.0, 22.0))
    case = PropagationCase(
        (30, 41),
        0.37,
        0.85,
        62.0,
        (0.21, -0.13),
        (1 / 400,),
        (9.0, -6.0),
        0.6,
        (3, 4),
        behind=behind,
    )
    slope = math.hypot(0.21, 0.13)
    sine = math.sin(math.atan(slope))
    inner, outer = math.asin(sine / 1.37), math.asin(sine / 1.52)
    s = (math.sin(inner - outer) / math.sin(inner + outer)) ** 2
    p = (math.tan(inner - outer) / math.tan(inner + outer)) ** 2
    assert direction._passed(case) == pytest.approx(1 - (s + p) / 2, rel=1e-9)
    assert direction._passed(CASE) == 1.0
