"""Light through a lens by the light that its wave lets through, by Fresnel's faces and
by areas of circles.
"""

import math

import numpy as np
import pytest
import torch

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.field import Optics, SmoothWave, Window
from metalens.field.through import through
from metalens.lens import Layers, Stop

R, D, WAVE = 45.0, 400.0, 0.83
WINDOW = Window(31, 2.0)


class Dimmed:
    """A focus whose lens lets less through beyond x of a place; keeps with what
    wavelength and angle it was asked.
    """

    def __init__(self, edge_um):
        self.focus, self.radius_um, self.edge_um, self.asked = (
            SmoothWave(Focus(WAVE, D, 2e3), R),
            R,
            edge_um,
            [],
        )

    def carrier_rad(self, x_um, y_um):
        return self.focus.carrier_rad(x_um, y_um)

    def factor(self, x_um, y_um, wavelength_um, angle_rad):
        self.asked.append((wavelength_um, angle_rad))
        level = torch.where(x_um > self.edge_um, 0.6, 0.9).to(torch.complex64)
        return level * torch.exp(1j * (0.01 * y_um)).to(torch.complex64)


def sums(wave, layers, places, depths, distance=D):
    at, far = (torch.tensor(v, dtype=torch.float64) for v in (places, depths))
    found = through(
        Optics(wave, layers, distance),
        at,
        depths_um=far,
        wavelength_um=WAVE,
        window=WINDOW,
    )
    assert found.shape == (len(places), len(depths))
    return found.numpy()


def beyond(edge):
    """Share of a disc of radius R to the right of a line."""
    u = edge / R
    return (math.acos(u) - u * math.sqrt(1 - u * u)) / math.pi


@pytest.mark.parametrize("edge", [-13.0, 21.0])
def test_the_squares_of_what_the_lens_lets_through_are_weighed_by_area(edge):
    """0.36 beyond a line and 0.81 before it; the light counts by places of the lens, of
    oblique rays too. A border
    lies within half a node of 5 um: 3.5 % of the area, by 0.45 of light."""
    wave = Dimmed(edge)
    found = sums(wave, Layers(), [(0.0, 0.0), (120.0, -70.0)], [2e3, 700.0, math.inf])
    want = 0.81 + (0.36 - 0.81) * beyond(edge)
    assert found == pytest.approx(np.full((2, 3), want), abs=0.016)
    assert [w for w, _ in wave.asked] == [WAVE] * len(wave.asked)
    angles = sorted({round(a, 12) for _, a in wave.asked})
    assert angles == pytest.approx(
        [0.0, math.atan(math.hypot(120.0, 70.0) / D)], rel=1e-10
    )


def test_angles_are_those_in_air_of_a_path_through_glass():
    """290 um of air and 110 um of index 1.7 bend as 290 + 110 / 1.7."""
    wave, glass = Dimmed(0.0), Layers(behind=(Film(Index(1.7), 110.0),))
    sums(wave, glass, [(31.0, 52.0)], [2e3])
    assert wave.asked[0][1] == pytest.approx(
        math.atan(math.hypot(31.0, 52.0) / (290 + 110 / 1.7)), rel=1e-12
    )


def test_oblique_light_passes_a_face_as_fresnel_has_it():
    """At the middle of the pupil, of 21 degrees: mean of both polarisations; over ± 5.5
    degrees its curvature is less
    than 1e-3."""
    glass, gap = Layers(behind=(Film(Index(1.7), 110.0),)), 290.0
    angle = math.radians(21.0)
    inner = math.asin(math.sin(angle) / 1.7)
    place = gap * math.tan(angle) + 110.0 * math.tan(inner)
    found = sums(
        SmoothWave(Focus(WAVE, D, 2e3, glass), R),
        glass,
        [(0.6 * place, -0.8 * place)],
        [2e3],
    )
    s = (math.sin(angle - inner) / math.sin(angle + inner)) ** 2
    p = (math.tan(angle - inner) / math.tan(angle + inner)) ** 2
    assert float(found[0, 0]) == pytest.approx(1 - (s + p) / 2, abs=1.5e-3)


def common(r, big, apart):
    """Area common to circles of two radii."""
    if apart <= abs(r - big):
        return math.pi * min(r, big) ** 2
    a = (apart**2 + r * r - big * big) / (2 * apart * r)
    b = (apart**2 + big * big - r * r) / (2 * apart * big)
    kite = (
        math.sqrt(
            (-apart + r + big)
            * (apart + r - big)
            * (apart - r + big)
            * (apart + r + big)
        )
        / 2
    )
    return r * r * math.acos(a) + big * big * math.acos(b) - kite


@pytest.mark.parametrize("depth", [1100.0, 3000.0, math.inf])
def test_a_stop_before_the_lens_lights_a_circle_of_which_the_lens_has_a_part(depth):
    """A hole of radius 25 at 160 um: from z it lights 25 z / (z - 160) about t z 160 /
    (z - 160), over the same circle
    on the axis. What is left is the rim in nodes of 4 um: 1 % of it."""
    hole = Layers(stop=Stop(25.0, 160.0))
    places = [(0.0, 0.0), (48.0, 64.0), (-90.0, 52.0)]
    grown = 1.0 if math.isinf(depth) else depth / (depth - 160.0)
    found = sums(SmoothWave(Focus(WAVE, D, 2e3), R), hole, places, [depth, 2.5e3])[:, 0]
    want = [
        common(25 * grown, R, 160 * grown * math.hypot(*at) / D)
        / (math.pi * (25 * grown) ** 2)
        for at in places
    ]
    assert want[0] == 1.0
    assert want[2] < 0.85
    assert found.tolist() == pytest.approx(want, abs=0.015)


def test_a_stop_beside_the_axis_is_where_it_is():
    """Its circle is 30 um aside: opposite fields see it leave the lens and stay on it."""
    hole = Layers(stop=Stop(25.0, 160.0, (24.0, -18.0)))
    near, far = sums(
        SmoothWave(Focus(WAVE, D, 2e3), R),
        hole,
        [(-60.0, 45.0), (60.0, -45.0)],
        [math.inf],
    )[:, 0]
    shift = 160 * 75.0 / D
    want = [
        common(25.0, R, apart) / (math.pi * 25.0**2)
        for apart in (30.0 - shift, 30.0 + shift)
    ]
    assert sorted([near, far], reverse=True) == pytest.approx(want, abs=0.015)
    assert abs(near - far) > 0.3
