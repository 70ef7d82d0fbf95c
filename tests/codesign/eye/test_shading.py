"""The shading of single rays in closed form: lamps, mirror lobes, albedos of iris,
sclera, skin; spheres.
"""

import math

import pytest
import torch

from tests.codesign.eye import model, plain_eye

BANK = torch.zeros(80, 256, 256, dtype=torch.float64)  # pictures without any texture
FAR = 1e9


def number(value):
    return torch.tensor(float(value), dtype=torch.float64)


def parameters(**named):
    """(COUNT,) of a frame, all else 0; vectors by their first index."""
    p = torch.zeros(model.COUNT, dtype=torch.float64)
    for name, value in named.items():
        place = getattr(model, name)
        values = torch.as_tensor(value, dtype=torch.float64).flatten()
        p[place : place + len(values)] = values
    return p


def test_a_lamp_falls_off_with_the_square_and_the_cosine_and_wraps():
    """At (3, -4, 12) mm: 169 mm² and 1 mm² that keep it finite; 1 is a lamp at 20 mm,
    straight on.
    """
    v = [number(1e3 * x) for x in (3, -4, 12)]
    n = [number(x) for x in (0.36, -0.48, 0.8)]
    cosine = (3 * 0.36 + 4 * 0.48 + 12 * 0.8) / math.sqrt(170)
    for wrap in (0.0, 0.35):
        assert float(plain_eye.lamp(*v, *n, wrap)) == pytest.approx(
            (cosine + wrap) * 400 / 170, rel=1e-12
        )
    behind = [-x for x in n]
    assert float(plain_eye.lamp(*v, *behind, 0.35)) == 0
    # at right angles to the lamp: only the wrap is left
    grazing = [number(x) for x in (0.8, 0.6, 0.0)]
    assert float(plain_eye.lamp(*v, *grazing, 0.3)) == pytest.approx(
        0.3 * 400 / 170, rel=1e-12
    )


def test_three_lamps_and_more_light_from_above():
    lamps = [[9e3, -5e3, 1e3], [-7e3, -4e3, 2e3], [1e3, -12e3, 3e3]]
    p = parameters(LED=lamps, AMBIENT=0.3, FACE_Y=[0.0, 0.6, -0.8])
    point = [number(x) for x in (500, 800, 19e3)]
    normal = [number(x) for x in (0.1, -0.3, -math.sqrt(0.9))]
    total = 0.0
    for lamp in lamps:
        v = [a - float(b) for a, b in zip(lamp, point, strict=True)]
        square = sum(x * x for x in v) + 1e6
        cosine = sum(x * float(n) for x, n in zip(v, normal, strict=True)) / math.sqrt(
            square
        )
        total += max(cosine + 0.35, 0) * 4e8 / square
    up = -0.3 * 0.6 + 0.8 * math.sqrt(0.9)
    want = total / 1.35 + 0.3 * (0.6 - 0.4 * up)
    assert float(plain_eye.lamps(p, *point, *normal, 0.35)) == pytest.approx(
        want, rel=1e-12
    )
    above, below = ([number(0), number(-0.6 * s), number(0.8 * s)] for s in (1, -1))
    assert float(plain_eye.ambient(p, *above)) == pytest.approx(0.3 * 1.0)
    assert float(plain_eye.ambient(p, *below)) == pytest.approx(0.3 * 0.2)


def test_a_wet_surface_and_the_iris_behind_it_have_the_light_of_three_lamps_and_two_mirror_images():
    """Wraps of 0.3 and 0.15, taken off again: as bright as without them where a lamp is
    straight on.
    """
    lamps = [[9e3, -5e3, 1e3], [-7e3, -4e3, 2e3], [1e3, -12e3, 3e3]]
    axis = (0.2, -0.1, -math.sqrt(0.95))
    normal = (0.1, -0.3, -math.sqrt(0.9))
    p = parameters(LED=lamps, AMBIENT=0.3, FACE_Y=[0.0, 0.6, -0.8], AXIS=axis)
    point = (500.0, 800.0, 19e3)
    sums, lobes = [0.0, 0.0], []
    for lamp in lamps:
        v = [a - b for a, b in zip(lamp, point, strict=True)]
        square = sum(x * x for x in v) + 1e6
        for k, (n, wrap) in enumerate(((normal, 0.3), (axis, 0.15))):
            cosine = sum(x * y for x, y in zip(v, n, strict=True)) / math.sqrt(square)
            sums[k] += max(cosine + wrap, 0) * 4e8 / square
        half = [
            x / math.sqrt(square) - d for x, d in zip(v, (0.0, 0.0, 1.0), strict=True)
        ]
        along = max(sum(h * n for h, n in zip(half, normal, strict=True)), 0)
        lobes.append(
            (1 + 50 / 2 * (1 - along**2 / (sum(h * h for h in half) + 1e-3))) ** -2
        )
    ambient = [0.3 * (0.6 - 0.4 * (0.6 * n[1] - 0.8 * n[2])) for n in (normal, axis)]
    ways = [[number(x) for x in part] for part in (point, normal, (0.0, 0.0, 1.0))]
    outer, inner, mirrored = plain_eye.wet_lamps(p, *ways[0], *ways[1], *ways[2], 50.0)
    assert float(outer) == pytest.approx(sums[0] / 1.3 + ambient[0], rel=1e-12)
    assert float(inner) == pytest.approx(sums[1] / 1.15 + ambient[1], rel=1e-12)
    assert float(mirrored) == pytest.approx(lobes[0] + lobes[1], rel=1e-12)


@pytest.mark.parametrize("off", [0.0, 0.04, -0.11])
def test_the_mirror_lobe_peaks_where_the_half_vector_is_the_normal(off):
    """1 / (1 + s/2 sin² a)²: a between normal and the half vector h of lamp and eye;
    |h|² + 0.001 keeps it finite.
    """
    sharp, turn = 900.0, 0.5
    # from the camera
    view = [number(math.sin(turn)), number(0.0), number(math.cos(turn))]
    # its mirror image about z
    lamp = [number(1e6 * math.sin(turn)), number(0.0), number(-1e6 * math.cos(turn))]
    normal = [number(math.sin(off)), number(0.0), number(-math.cos(off))]
    p = parameters(AXIS=[0.0, 0.0, -1.0])
    outer, inner, shine = plain_eye.wet_lamp(p, *lamp, *normal, *view, sharp)
    square = 4 * math.cos(turn) ** 2
    apart = 1 - math.cos(off) ** 2 * square / (square + 1e-3)
    # the lamp's own 1 mm in 1 m
    assert float(shine) == pytest.approx(1 / (1 + sharp / 2 * apart) ** 2, rel=1e-3)
    fall = 4e8 / (1e12 + 1e6)
    assert float(outer) == pytest.approx((math.cos(turn - off) + 0.3) * fall, rel=1e-5)
    assert float(inner) == pytest.approx((math.cos(turn) + 0.15) * fall, rel=1e-5)


def test_the_iris_darkens_at_the_limbus_and_at_the_pupil():
    p = parameters(
        IRIS=0.37, IRIS_CONTRAST=0.4, PUPIL_R=1700.0, LIMBUS_R=5900.0, TURN_X=1.0
    )

    def smooth(x):
        t = min(max(0.5 + 0.5 * x, 0), 1)
        return t * t * (3 - 2 * t)

    for r in (1700.0, 1800.0, 3000.0, 5500.0, 5900.0):
        span = (r - 1700) / 4200
        want = (
            0.37
            * (1 - 0.45 * smooth((span - 0.94) * 9))
            * (1 - 0.35 * smooth((0.03 - span) * 25))
        )
        got = plain_eye.pigment(p, BANK, number(0.6 * r), number(-0.8 * r), number(r))
        assert float(got) == pytest.approx(want, rel=1e-12)
    bright = BANK + 0.5
    middle = plain_eye.pigment(
        p, bright, number(1800.0), number(-2400.0), number(3000.0)
    )
    assert float(middle) == pytest.approx(0.37 * 1.2)


def test_the_sclera_has_its_ring_its_flesh_and_its_tear_film():
    p = parameters(SCLERA=0.61, VEINS=0.2, SKIN=0.5, LIMBUS_R=5800.0, CARUNCLE=-9000.0)
    axis = number(0.0)

    def white(gx=FAR, gy=0.0, lower=FAR, r=FAR, inside=1.0):
        given = (number(v) for v in (gx, gy, lower))
        return float(
            plain_eye.sclera(
                p, BANK, *given, axis, axis, axis, number(r), number(inside)
            )
        )

    assert white() == pytest.approx(0.61)
    assert white(r=5800.0) == pytest.approx(0.61 * 0.75)
    assert white(r=5800.0 + 1300.0) == pytest.approx(0.61 * 0.875)
    assert white(r=5800.0, inside=0.0) == pytest.approx(0.61)
    assert white(gx=-9000.0, gy=500.0) == pytest.approx(0.4)  # 0.8 of the skin
    assert white(gx=-9000.0 + math.sqrt(3.2e6), gy=500.0) == pytest.approx(
        (0.4 + 0.61) / 2
    )
    assert white(lower=120.0) == pytest.approx(0.73)
    assert white(lower=-30.0) == pytest.approx(0.67)


def test_creases_margins_and_brow_of_the_skin():
    """Lit by ambient light alone from straight above: 1 times the albedo and the gain."""
    p = parameters(
        SKIN=0.52,
        CREASE=2600.0,
        GAIN=1.7,
        AMBIENT=1.0,
        FACE_Y=[0.0, 1.0, 0.0],
        BROW=1.25,
        LED=[FAR] * 9,
    )
    up = [number(v) for v in (0.0, -1.0, 0.0)]
    ray = [number(v) for v in (0.0, 0.0, 1.0)]

    def skin(upper=-FAR, lower=-FAR, gy=FAR, gx=0.0, p=p):
        given = (number(v) for v in (20e3, gx, gy, upper, lower))
        return float(plain_eye.skin(p, BANK, *given, *ray, *up)) / (0.52 * 1.7)

    assert skin() == pytest.approx(1.0)
    margin = 1 - 0.25 / (1 + (2350 / 260) ** 2)
    assert skin(upper=-2600.0) == pytest.approx(0.58 * margin)
    fold = 1 - 0.42 / (1 + (2350 / 260) ** 2)
    assert skin(upper=-250.0) == pytest.approx(0.75 * fold)
    rim = 0.10 / 0.52 / (1 + (2270 / 330) ** 4)
    assert skin(lower=-2600.0) == pytest.approx(0.8 + rim)
    pouch = 1 - 0.20 / (1 + (2270 / 420) ** 2)
    assert skin(lower=-330.0) == pytest.approx(pouch + 0.10 / 0.52)
    # 1.25 * 0.8 of the brow's opacity
    assert skin(gy=-17000.0) == pytest.approx(1 - 0.75 * 1.0)
    assert skin(gy=-17000.0 - 6000**2 / 60000.0 + 2600.0, gx=6000.0) == pytest.approx(
        1 - 0.75 * 0.5
    )


def test_rays_on_the_axis_meet_sphere_lids_and_cornea_where_they_stand():
    eye = {
        "CENTRE": [0.0, 0.0, 30e3],
        "AXIS": [0.0, 0.0, -1.0],
        "FACE_Z": [0.0, 0.0, -1.0],
        "FACE_X": [1.0, 0.0, 0.0],
    }
    p = parameters(
        **eye, FACE_Y=[0.0, 1.0, 0.0], PLANE=[0.0, 0.0, 27e3], SCLERA_R=11.8e3, CORNEA_R=7.7e3, CORNEA_D=5.6e3,
        LIMBUS_D=10e3, LID_R=12.9e3, BLEND=1600.0, EDGE=40.0, UPPER=5100.0, LOWER=4300.0, HALF=11e3, MIDDLE=700.0,
    )  # fmt: skip
    ahead = [number(v) for v in (0.0, 0.0, 1.0)]
    distance, mx, my, mz = plain_eye.globe(p, *ahead)
    assert [float(v) for v in (distance, mx, my, mz)] == pytest.approx(
        [18.2e3, 0, 0, -1]
    )
    distance, cx, cy, cz, inside = plain_eye.cornea(p, *ahead)
    assert [float(v) for v in (distance, cx, cy, cz, inside)] == pytest.approx(
        [16.7e3, 0, 0, -1, 1]
    )
    s, openness, gx, gy, upper, lower, nx, ny, nz = plain_eye.lids(p, *ahead)
    # the shell; the plane stands 10 mm behind it
    assert float(s) == pytest.approx(17.1e3)
    arch = 1 - (700 / 11e3) ** 2
    assert [float(v) for v in (openness, gx, gy)] == pytest.approx([1, 0, 0])
    assert [float(v) for v in (upper, lower)] == pytest.approx(
        [5100 * arch, 4300 * arch]
    )
    assert [float(v) for v in (nx, ny, nz)] == pytest.approx([0, 0, -1], abs=1e-6)


def test_steps_and_textures_between_their_pixels():
    steps = plain_eye.step(
        torch.tensor([-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0], dtype=torch.float64)
    )
    assert steps.tolist() == pytest.approx([0, 0, 0.15625, 0.5, 0.84375, 1, 1])
    bank = torch.randn(
        3, 256, 256, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    which = number(2)
    assert float(plain_eye.tex(bank, which, number(17.0), number(255.0))) == float(
        bank[2, 255, 17]
    )
    assert float(plain_eye.tex(bank, which, number(-1.0), number(256.0))) == float(
        bank[2, 0, 255]
    )  # pictures repeat
    half = plain_eye.tex(bank, which, number(255.5), number(31.0))
    assert float(half) == pytest.approx(float((bank[2, 31, 255] + bank[2, 31, 0]) / 2))
    part = plain_eye.tex(bank, which, number(40.25), number(8.75))
    s, t = 0.15625, 0.84375
    top = bank[2, 8, 40] * (1 - s) + bank[2, 8, 41] * s
    low = bank[2, 9, 40] * (1 - s) + bank[2, 9, 41] * s
    assert float(part) == pytest.approx(float(top * (1 - t) + low * t))
