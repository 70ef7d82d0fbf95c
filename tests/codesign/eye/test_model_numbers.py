"""What a pixel sees of a face and an eye turned every way: rays drawn backwards from
where they end, light by sums.

Points on spheres and planes are chosen first and the camera's ray is the one through
them; inside the eye the direction
behind the cornea is chosen and Snell's law gives the one before it. So nothing here
solves for a meeting point.
"""

import numpy as np
import pytest
import torch

from codesign.eye import model

PICTURES = np.random.default_rng(11).uniform(
    -1, 1, (5, 97, 97)
)  # a prime: no shift by a whole period hides
BANK = torch.tensor(PICTURES)
T_IRIS, T_VEIN, T_SKIN, T_FINE, T_LASH = range(5)
OFFSET = (17.3, 41.8)
LAMPS = np.array([[9e3, -5e3, 1e3], [-7e3, -4e3, 2e3], [1e3, -12e3, 3e3]])
TURN = 0.7  # rad
NUMBERS = {
    "SCLERA_R": 12_000.0, "CORNEA_R": 7_700.0, "CORNEA_D": 5_100.0, "LIMBUS_R": 5_800.0, "LIMBUS_D": 9_900.0,
    "PUPIL_R": 1_900.0, "PUPIL_D": 9_300.0, "INDEX": 1.376, "LID_R": 13_100.0, "BLEND": 1_600.0, "EDGE": 40.0,
    "UPPER": 4_900.0, "LOWER": 5_700.0, "SKEW": 400.0, "MIDDLE": 450.0, "HALF": 12_000.0, "CREASE": 2_300.0,
    "IRIS": 0.37, "IRIS_CONTRAST": 0.4, "SCLERA": 0.61, "VEINS": 0.23, "SKIN": 0.52, "PORES": 0.19, "LASHES": 0.6,
    "PUPIL": 0.03, "GLINT": 2.5, "AMBIENT": 0.31, "GAIN": 1.7, "BROW": 0.7, "T_IRIS": T_IRIS, "T_VEIN": T_VEIN,
    "T_SKIN": T_SKIN, "T_FINE": T_FINE, "T_LASH": T_LASH, "OFFSET_X": OFFSET[0], "OFFSET_Y": OFFSET[1],
    "TURN_X": np.cos(TURN), "TURN_Y": np.sin(TURN), "CARUNCLE": -8_800.0,
}  # fmt: skip


def axes(seed, tilt):
    """Right-handed axes of which the third one points to the camera, tilted."""
    draw = np.random.default_rng(seed)
    out = np.array([tilt * draw.normal(), tilt * draw.normal(), -1.0])
    out /= np.linalg.norm(out)
    right = np.cross(draw.normal(size=3), out)
    right /= np.linalg.norm(right)
    return right, np.cross(out, right), out


FACE, EYE = axes(3, 0.1), axes(5, 0.25)
CENTRE = np.array([1300.0, -800.0, 33_000.0])
PLANE = CENTRE + 2000 * FACE[2]  # far behind the lids' shell


def parameters(**changed):
    """(COUNT,) of a frame: vectors and numbers as above, or as they are given."""
    vectors = {
        "CENTRE": CENTRE,
        "FACE_X": FACE[0],
        "FACE_Y": FACE[1],
        "FACE_Z": FACE[2],
        "AXIS": EYE[2],
    }
    vectors |= {
        "IRIS_X": EYE[0],
        "IRIS_Y": EYE[1],
        "PLANE": PLANE,
        "LED": LAMPS.ravel(),
    }
    p = torch.full((model.COUNT,), torch.nan, dtype=torch.float64)
    for name, value in (vectors | NUMBERS | changed).items():
        place, values = getattr(model, name), np.atleast_1d(value)
        p[place : place + len(values)] = torch.tensor(values, dtype=torch.float64)
    assert not bool(p.isnan().any())
    return p


def tensors(*values):
    """Every number of numbers and vectors as a tensor."""
    return [
        torch.tensor(float(v), dtype=torch.float64)
        for part in values
        for v in np.atleast_1d(part)
    ]


def floats(values):
    return [float(v) for v in values]


def near(values):
    return pytest.approx(
        [float(v) for part in values for v in np.atleast_1d(part)], rel=1e-9, abs=1e-9
    )


def unit(vector):
    return vector / np.linalg.norm(vector)


def smooth(x):
    t = min(max((1 + x) / 2, 0.0), 1.0)
    return t * t * (3 - 2 * t)


def picture(k, u, v):
    """A picture between its pixels: rows down, columns right, periodic, blended by
    smooth steps.
    """
    i, j = int(np.floor(u)), int(np.floor(v))
    s, t = (part * part * (3 - 2 * part) for part in (u - i, v - j))
    total = 0.0
    for a, b in ((0, 0), (1, 0), (0, 1), (1, 1)):
        total += (
            PICTURES[k, (j + b) % 97, (i + a) % 97]
            * (s if a else 1 - s)
            * (t if b else 1 - t)
        )
    return total


def bell(x, power=2):
    return 1 / (1 + x**power)


def test_indices_leave_no_gap():
    """Nine vectors of three, three lamps, 36 numbers: 72 in all; what moves is a name
    of the table.
    """
    starts = [
        "CENTRE",
        "FACE_X",
        "FACE_Y",
        "FACE_Z",
        "AXIS",
        "IRIS_X",
        "IRIS_Y",
        "PLANE",
        "LED",
    ]
    assert [getattr(model, name) for name in starts] == [0, 3, 6, 9, 12, 15, 18, 21, 24]
    assert sorted(getattr(model, name) for name in NUMBERS) == list(range(33, 72))
    assert (model.COUNT, model.LED_COUNT) == (72, 3)


def test_a_ray_is_a_unit_vector_through_its_tangents():
    """(2, -3, 6) / 7 through (1/3, -1/2)."""
    assert floats(model.ray(*tensors(1 / 3, -1 / 2))) == near([2 / 7, -3 / 7, 6 / 7])


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.31, -0.52), (-0.66, 0.24)])
def test_the_globe_is_met_at_the_point_that_the_ray_was_drawn_through(off):
    """C + R n, n facing the camera: the distance is the point's own, the normal is n."""
    normal = unit(np.array([*off, -1.0]))
    point = CENTRE + 12_000 * normal
    assert floats(model.globe(parameters(), *tensors(unit(point)))) == near(
        [np.linalg.norm(point), normal]
    )


def test_a_ray_past_the_globe_ends_a_millimetre_before_it_passes():
    d = unit(np.array([0.7, 0.2, 1.0]))
    along = CENTRE @ d
    want = [along - 1000, ((along - 1000) * d - CENTRE) / 12_000]
    assert floats(model.globe(parameters(), *tensors(d))) == near(want)


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.31, -0.52), (-0.36, 0.24)])
def test_the_cornea_is_met_at_its_own_point_and_ends_softly_at_the_limbus(off):
    """Its apex is 5.1 + 7.7 mm before the centre of the globe; a point whose normal has
    the cosine c with the axis is
    5.1 + 7.7 c mm before it, the limbus 9.9 mm."""
    normal = unit(np.array([*off, -1.0]))
    point = CENTRE + 5_100 * EYE[2] + 7_700 * normal
    before = 5_100 + 7_700 * (normal @ EYE[2])
    want = [np.linalg.norm(point), normal, smooth((before - 9_900) / 80)]
    assert floats(model.cornea(parameters(), *tensors(unit(point)))) == near(want)


@pytest.mark.parametrize("over", [-60.0, -30.0, 20.0, 70.0, 90.0])
def test_the_cornea_fades_over_two_edges_about_the_limbus(over):
    """``over`` um before the limbus, an edge of 40 um: smooth from -80 to 80."""
    cosine = (9_900 + over - 5_100) / 7_700
    normal = cosine * EYE[2] + np.sqrt(1 - cosine**2) * (0.6 * EYE[0] - 0.8 * EYE[1])
    point = CENTRE + 5_100 * EYE[2] + 7_700 * normal
    inside = floats(model.cornea(parameters(), *tensors(unit(point))))[4]
    assert inside == pytest.approx(smooth(over / 80), rel=1e-9)


@pytest.mark.parametrize("share", [0.3, 0.85, 1.4])
def test_the_cornea_fades_where_the_ray_grazes_it(share):
    """The ray passes R² sin² from the middle and leaves R² cos² of the sphere: whole
    above 2e5 um², 450 um of R.

    The eye looks the way of the normal there, so that the limbus is far."""
    cosine = np.sqrt(share * 2e5) / 7_700
    d = unit(np.array([0.1, -0.2, 1.0]))
    normal = np.sqrt(1 - cosine**2) * unit(np.cross(d, [0.3, 1.0, 0.2])) - cosine * d
    middle = 30_000 * d - 7_700 * normal
    p = parameters(CENTRE=middle - 5_100 * normal, AXIS=normal)
    assert floats(model.cornea(p, *tensors(d))) == near([30_000, normal, min(share, 1)])


def test_a_ray_past_the_cornea_sees_none_of_it():
    """The distance is that to the nearest place, less the 100 um that keep the root
    finite.
    """
    d = unit(np.array([0.5, -0.4, 1.0]))
    middle = CENTRE + 5_100 * EYE[2]
    along = middle @ d
    want = [along - 100, ((along - 100) * d - middle) / 7_700, 0]
    assert floats(model.cornea(parameters(), *tensors(d))) == near(want)


def bent(normal, inner, index=1.376):
    """The direction before the cornea of a ray that goes on as ``inner``: across the
    normal ``index`` times as much.
    """
    across = index * (inner - (inner @ normal) * normal)
    return across - np.sqrt(1 - across @ across) * normal


RAYS = [
    ((0.2, -0.3), (0.1, 0.25), 3_200.0),
    ((-0.35, 0.1), (0.2, -0.05), 2_700.0),
    ((0.05, 0.4), (-0.3, -0.1), 4_100.0),
]


def refracted(off, inner, path, **changed):
    """(parameters, tc, normal, direction, place in the plane of the iris) of a ray that
    was drawn from its end.
    """
    normal, behind = unit(np.array([*off, -1.0])), unit(np.array([*inner, 1.0]))
    d = bent(normal, behind)
    hit = 30_000 * d
    centre = hit - 7_700 * normal - 5_100 * EYE[2]
    end = hit + path * behind - centre
    return (
        parameters(CENTRE=centre, PUPIL_D=end @ EYE[2], **changed),
        30_000.0,
        normal,
        d,
        (end @ EYE[0], end @ EYE[1]),
    )


@pytest.mark.parametrize("ray", RAYS)
def test_a_ray_goes_through_the_cornea_to_where_it_was_drawn_from(ray):
    p, tc, normal, d, place = refracted(*ray)
    assert floats(model.refract(p, *tensors(tc, normal, d))) == near([*place, ray[2]])


def test_a_ray_along_the_iris_is_held_at_a_slope_of_a_twentieth():
    """Straight through a cornea of index 1, 0.03 down the axis in every um: 600 um
    before the plane, 12 mm on.
    """
    slow = 0.03
    d = unit(np.array([0.1, -0.2, 1.0]))
    across = unit(np.cross(d, [0.3, 1.0, 0.2]))
    axis = np.sqrt(1 - slow**2) * across - slow * d
    normal = unit(across - d)
    right = unit(np.cross(axis, d))
    down = np.cross(axis, right)
    hit = 30_000 * d
    p = parameters(
        CENTRE=hit - 900 * right - 400 * down - 9_900 * axis,
        AXIS=axis,
        IRIS_X=right,
        IRIS_Y=down,
        INDEX=1.0,
    )
    end = 12_000 * d
    want = [900 + end @ right, 400 + end @ down, 12_000]
    assert floats(model.refract(p, *tensors(30_000, normal, d))) == near(want)


def test_a_cornea_behind_the_iris_leaves_the_ray_where_it_is():
    p, tc, normal, d, _ = refracted(*RAYS[0])
    p[model.PUPIL_D] += 5_000
    hit = tc * d - p[model.CENTRE : model.CENTRE + 3].numpy()
    assert floats(model.refract(p, *tensors(tc, normal, d))) == near(
        [hit @ EYE[0], hit @ EYE[1], 0]
    )


def test_light_that_would_be_thrown_back_goes_on_a_hundredth_off_the_surface():
    """Index 0.8 at a sine of 0.9: sqrt(1e-4) of the normal in place of the root of less
    than nothing.
    """
    normal, across = EYE[2], 0.6 * EYE[0] + 0.8 * EYE[1]
    d = 0.9 * across - np.sqrt(0.19) * normal
    k = np.sqrt(0.19) / 0.8 - 0.01
    inner = d / 0.8 + k * normal  # down the axis by 0.01: held at 0.05
    p = parameters(CENTRE=30_000 * d - 9_500 * normal, INDEX=0.8)
    want = [4_000 * inner @ EYE[0], 4_000 * inner @ EYE[1], 4_000]
    assert floats(model.refract(p, *tensors(30_000, normal, d))) == near(want)


def pigment(x, y, r, pupil=1_900.0, span=3_900.0):
    """Radius 40 to 124 pixels of the picture about (128, 128), turned; dark at the
    limbus and about the pupil.
    """
    part = min(max((r - pupil) / span, 0), 1)
    angle, reach = np.arctan2(y, x) + TURN, (40 + 84 * part) * np.hypot(x, y) / r
    figure = picture(T_IRIS, 128 + reach * np.cos(angle), 128 + reach * np.sin(angle))
    dark = (1 - 0.45 * smooth((part - 0.94) * 9)) * (
        1 - 0.35 * smooth((0.03 - part) * 25)
    )
    return 0.37 * (1 + 0.4 * figure) * dark


@pytest.mark.parametrize(
    ("x", "y"),
    [
        (1_300.0, -900.0),
        (1_100.0, 1_600.0),
        (-2_400.0, 1_800.0),
        (-700.0, -5_500.0),
        (4_600.0, 3_900.0),
    ],
)
def test_the_iris_is_a_picture_about_its_middle_that_stretches_with_the_pupil(x, y):
    r = np.hypot(x, y)
    found = float(model.pigment(parameters(), BANK, *tensors(x, y, r)))
    assert found == pytest.approx(pigment(x, y, r), rel=1e-9)
    narrow = float(
        model.pigment(parameters(PUPIL_R=5_650.0), BANK, *tensors(x, y, r))
    )  # at least 300 um of iris
    assert narrow == pytest.approx(pigment(x, y, r, 5_650.0, 300.0), rel=1e-9)


@pytest.mark.parametrize("ray", RAYS)
@pytest.mark.parametrize("inside", [1.0, 0.4])
def test_pupil_and_iris_are_discs_with_soft_rims_behind_the_cornea(ray, inside):
    """A limbus 25 um and a pupil 13 um beyond the place, 240 um and 40 um soft; the
    iris is seen where a surface of
    one curvature forms its image: 1/s' = n/s - (n - 1)/R."""
    p, tc, normal, d, (x, y) = refracted(*ray)
    r = np.sqrt(x * x + y * y + 1)
    virtual = 1 / (1.376 / ray[2] - 0.376 / 7_700)
    for limbus, pupil in (
        (r + 5_000, r + 13),
        (r + 25, r - 900),
        (r - 70, r - 950),
        (r + 400, r - 17),
    ):
        p[model.LIMBUS_R], p[model.PUPIL_R] = limbus, pupil
        disc = inside * smooth((limbus - r) / 240)
        brown = pigment(x, y, r, pupil, limbus - pupil)
        want = [disc, disc * smooth((pupil - r) / 40), r, brown, virtual]
        assert floats(model.iris(p, BANK, *tensors(tc, normal, inside, d))) == near(
            want
        )


def on_plane(gx, gy, before=15_500.0):
    """(parameters, direction, distance) of a ray to a face that stands ``before`` the
    eye, far before the lids.
    """
    point = CENTRE + gx * FACE[0] + gy * FACE[1] + before * FACE[2]
    p = parameters(PLANE=CENTRE + before * FACE[2] + 300 * FACE[0] - 700 * FACE[1])
    return p, unit(point), np.linalg.norm(point)


@pytest.mark.parametrize(
    ("over", "under"),
    [(12.0, 9_000.0), (-25.0, 9_000.0), (9_000.0, 7.0), (9_000.0, -31.0)],
)
def test_margins_of_the_lids_are_skewed_parabolas(over, under):
    """A quarter of the half width beside the middle the arch is 15/16: above 15/16
    (4900 + 100), below 15/16 (5700 -
    100), so 4687.5 and 5250 um; open by smooth steps of 40 um to either side."""
    gy = over - 4_687.5 if over < 9_000 else 5_250 - under
    p, d, distance = on_plane(3_450.0, gy)
    upper, lower = gy + 4_687.5, 5_250 - gy
    found = floats(model.lids(p, *tensors(d)))
    assert found[0] == pytest.approx(distance, rel=1e-9)
    assert found[2:6] == near([3_450, gy, upper, lower])
    assert found[1] == pytest.approx(
        smooth(upper / 40) * smooth(lower / 40), rel=1e-6, abs=1e-12
    )
    assert found[6:] == near(FACE[2] / np.sqrt(1 + 1e-6))


@pytest.mark.parametrize("gap", [-10.0, 22.0, 61.0, 78.0, 95.0])
def test_lids_that_all_but_touch_are_shut(gap):
    """Nothing of 0 um and less apart, all of 80 um and more, smooth between; beside
    that the steps of both margins.
    """
    p, d, _ = on_plane(450.0, -100.0)
    p[model.UPPER], p[model.LOWER] = 100 + 0.4 * gap, 0.6 * gap - 100
    want = smooth(0.4 * gap / 40) * smooth(0.6 * gap / 40) * smooth(gap / 40 - 1)
    assert float(model.lids(p, *tensors(d))[1]) == pytest.approx(
        want, rel=1e-6, abs=1e-12
    )


@pytest.mark.parametrize("behind", [-0.7, -0.2, 0.0, 0.2, 0.6, 1.3])
@pytest.mark.parametrize("off", [(0.05, 0.1), (0.31, -0.52)])
def test_shell_and_face_are_one_smooth_front(behind, off):
    """A face ``behind`` blends behind the shell takes part (1 - behind)/2 in place and
    normal; half a blend times the
    product of both parts is what the front swells towards the camera."""
    normal = unit(np.array([*off, -1.0]))
    point = CENTRE + 13_100 * normal
    d, shell = unit(point), np.linalg.norm(point)
    plane = shell + behind * 1_600
    p = parameters(PLANE=plane * d + 900 * FACE[0] - 350 * FACE[1])
    h = min(max((1 + behind) / 2, 0), 1)
    s = h * shell + (1 - h) * plane - 800 * h * (1 - h)
    q = s * d - CENTRE
    mixed = h * q / 13_100 + (1 - h) * FACE[2]
    found = floats(model.lids(p, *tensors(d)))
    assert found[0] == pytest.approx(s, rel=1e-9)
    assert found[2:4] == near([q @ FACE[0], q @ FACE[1]])
    assert found[6:] == near(mixed / np.sqrt(mixed @ mixed + 1e-6))


def test_a_ray_past_the_shell_and_along_the_face_ends_at_held_distances():
    """The shell a millimetre before its nearest place; a face that falls away by 0.02
    is met as if by 0.05.
    """
    d = unit(np.array([0.9, 0.3, 1.0]))
    across = unit(np.cross(d, [0.2, 1.0, -0.3]))
    out = np.sqrt(1 - 0.02**2) * across - 0.02 * d
    shell = CENTRE @ d - 1000
    past = parameters(PLANE=3 * shell * d)
    assert float(model.lids(past, *tensors(d))[0]) == pytest.approx(shell, rel=1e-9)
    along = parameters(FACE_Z=out, PLANE=-500 * out)
    assert float(model.lids(along, *tensors(d))[0]) == pytest.approx(10_000, rel=1e-9)


def ambient(normal):
    """0.31 of diffuse light: 0.6 level, 1 from straight above, 0.2 from below."""
    return 0.31 * (0.6 - 0.4 * normal @ FACE[1])


def lit(point, normal, wrap):
    """Light of each lamp: 1 at 20 mm straight on; a millimetre is added to every
    distance, squared.
    """
    found = []
    for lamp in LAMPS:
        v = lamp - point
        far = np.sqrt(v @ v + 1e6)
        found.append(max(v @ normal / far + wrap, 0) * 20_000.0**2 / far**2)
    return found


def shine(point, normal, d, sharp):
    """Mirror images of the first two lamps about the half vector between lamp and
    camera.
    """
    total = 0.0
    for lamp in LAMPS[:2]:
        v = lamp - point
        half = v / np.sqrt(v @ v + 1e6) - d
        cosine = max(half @ normal, 0) ** 2 / (half @ half + 1e-3)
        total += (1 + sharp / 2 * (1 - cosine)) ** -2
    return total


SKINS = [  # gx, gy, to the upper and the lower margin, lashes, brow
    (2_700.0, -1_300.0, -420.0, 6_100.0, 0.6, 0.7),
    (-3_900.0, -2_100.0, -90.0, 5_200.0, 0.6, 0.7),
    (1_800.0, 4_700.0, 7_300.0, -650.0, 0.6, 0.7),
    (4_300.0, 5_100.0, 9_100.0, -230.0, 0.6, 0.7),
    (-6_200.0, -3_000.0, -4_600.0, 9_900.0, 5.0, 0.7),
    (-1_700.0, 3_300.0, 7_000.0, -2_900.0, 5.0, 0.7),
    (5_600.0, -15_500.0, -11_000.0, 21_000.0, 0.6, 0.7),
    (-2_200.0, -18_900.0, -14_000.0, 24_000.0, 0.6, 0.4),
    (3_200.0, -17_100.0, -12_000.0, 22_000.0, 0.6, 40.0),
    (400.0, 100.0, -2_250.0, -2_480.0, 0.6, 0.7),
]


@pytest.mark.parametrize(("gx", "gy", "upper", "lower", "lashes", "brow"), SKINS)
def test_skin_has_pores_creases_margins_lashes_and_a_brow(
    gx, gy, upper, lower, lashes, brow
):
    """Pictures of 100 um pixels, a third of that for the fine one; lashes over 3.8 and
    2.6 mm, a brow 17 mm up.
    """
    one, two = OFFSET
    coarse = picture(T_SKIN, gx / 100 + one, gy * 0.012 + two)
    fine = picture(T_FINE, gx * 0.03 + two, gy * 0.036 + one)
    up, down = min(max(-upper / 3800, 0), 1), min(max(-lower / 2600, 0), 1)
    long = picture(T_LASH, gx * 0.016 + one, 255 * up) * smooth(20 * up - 1)
    short = picture(T_LASH, gx * 0.011 + two, 255 * down) * smooth(8 * down - 1)
    lash = min(max(lashes * (long + short / 2), 0), 1)
    arc = (gy + 17_000 + gx * gx / 60_000) / 2_600
    hair = min(max(brow * (0.8 + 1.6 * fine) * bell(arc, 4), 0), 1)
    creases = (1 - 0.42 * bell((upper + 2_300 + 160 * coarse) / 260)) * (
        1 - 0.2 * bell((lower + 2_600 + 350 * coarse) / 420)
    )
    albedo = (
        0.52
        * (1 + 0.19 * (coarse + 0.7 * fine))
        * creases
        * (1 - 0.25 * bell((upper + 250) / 260))
    )
    albedo = (
        (albedo + 0.1 * bell((lower + 330) / 330, 4))
        * (1 - 0.85 * lash)
        * (1 - 0.75 * hair)
    )
    d, normal = unit(np.array([0.11, -0.17, 1.0])), unit(np.array([0.4, -0.3, -1.0]))
    light = sum(lit(24_000 * d, normal, 0.35)) / 1.35 + ambient(normal)
    p = parameters(LASHES=lashes, BROW=brow)
    found = float(
        model.skin(p, BANK, *tensors(24_000, gx, gy, upper, lower, d, normal))
    )
    assert found == pytest.approx(albedo * light * 1.7, rel=1e-9)


# gx, gy, to the lower margin, (x, y) of the normal in the eye's axes, from the axis
SCLERAS = [
    (1_200.0, -800.0, 3_000.0, (0.31, -0.47), 6_900.0, 0.6),
    (-7_700.0, 1_500.0, 2_400.0, (-0.52, 0.18), 9_300.0, 0.0),
    (-8_300.0, -400.0, 2_900.0, (-0.6, 0.1), 12_000.0, 0.3),
    (3_300.0, 4_100.0, 170.0, (0.22, 0.38), 5_100.0, 1.0),
    (-500.0, 3_900.0, 40.0, (0.05, 0.61), 7_600.0, 0.2),
]


def white(gx, gy, lower, place, r, inside):
    """190 pixels of vessels to the radius; a ring about the limbus, flesh in the
    corner, a film of tears below.
    """
    vein = picture(T_VEIN, 190 * place[0] + OFFSET[0], 190 * place[1] + OFFSET[1])
    ball = 0.61 * (1 - 0.23 * vein) * (1 - 0.25 * inside * bell((r - 5_800) / 1_300))
    corner = bell(((gx + 8_800) ** 2 + (gy - 500) ** 2) / 3.2e6, 3)
    flesh = 0.8 * 0.52 * (1 + 0.3 * vein)
    return ball * (1 - corner) + flesh * corner + 0.12 * bell((lower - 120) / 150, 4)


@pytest.mark.parametrize(("gx", "gy", "lower", "place", "r", "inside"), SCLERAS)
def test_the_sclera_has_vessels_a_ring_flesh_and_tears(gx, gy, lower, place, r, inside):
    normal = (
        place[0] * EYE[0]
        + place[1] * EYE[1]
        + np.sqrt(1 - place[0] ** 2 - place[1] ** 2) * EYE[2]
    )
    found = float(
        model.sclera(parameters(), BANK, *tensors(gx, gy, lower, normal, r, inside))
    )
    assert found == pytest.approx(white(gx, gy, lower, place, r, inside), rel=1e-9)


SPHERE, BULGE = unit(np.array([0.3, -0.2, -1.0])), unit(np.array([-0.1, -0.35, -1.0]))
AHEAD = unit(np.array([0.07, 0.12, 1.0]))


def shaded(
    albedo,
    brown,
    disc,
    pupil,
    inside,
    upper,
    lower,
    ts,
    tc,
    sphere=SPHERE,
    bulge=BULGE,
    d=AHEAD,
):
    """Wet surface, iris behind it (of the part of it that is not pupil), what the lids
    take away, mirror images.
    """
    point, normal = (
        (1 - inside) * ts * d + inside * tc * d,
        (1 - inside) * sphere + inside * bulge,
    )
    outer = sum(lit(point, normal, 0.3)) / 1.3 + ambient(normal)
    inner = sum(lit(point, EYE[2], 0.15)) / 1.15 + ambient(EYE[2])
    shadow = 1 - 0.5 / (1 + max(upper, 0) / 900) ** 2 - 0.15 / (1 + max(lower, 0) / 500)
    ring = disc * (1 - pupil / max(disc, 1e-3))
    body = albedo * outer * (1 - disc) + ring * brown * inner + 0.03 * pupil
    return 1.7 * (body * shadow + 2.5 * shine(point, normal, d, 250 + 1750 * inside))


SHADES = [  # disc, pupil, inside, upper, lower
    (0.0, 0.0, 0.0, 2_100.0, 3_300.0),
    (1.0, 0.35, 1.0, 700.0, 4_000.0),
    (0.6, 0.2, 0.7, 4_300.0, 260.0),
    (0.4, 0.4, 0.4, -150.0, 900.0),
    (1e-4, 3e-5, 0.2, 1_500.0, -80.0),
]


@pytest.mark.parametrize("case", SHADES)
def test_the_eye_is_wet_and_shaded_by_its_lids(case):
    numbers = 0.57, 0.29, *case
    given = tensors(*numbers, 21_500, SPHERE, 20_300, BULGE, AHEAD)
    found = float(model.shade(parameters(), *given))
    assert found == pytest.approx(shaded(*numbers, 21_500, 20_300), rel=1e-9)


def test_mirror_images_shine_where_the_normal_halves_the_way():
    """The cornea's lobe is eight times as narrow as the globe's; a normal that looks
    away mirrors nothing.
    """
    v = LAMPS[0] - 20_300 * AHEAD
    half = unit(v / np.sqrt(v @ v + 1e6) - AHEAD)
    for normal, inside in (
        (half, 1.0),
        (half, 0.0),
        (-half, 1.0),
        (unit(half + 0.05 * EYE[0]), 0.5),
    ):
        numbers = 0.57, 0.29, 0.3, 0.1, inside, 800.0, 900.0
        found = float(
            model.shade(
                parameters(), *tensors(*numbers, 20_300, normal, 20_300, normal, AHEAD)
            )
        )
        want = shaded(*numbers, 20_300, 20_300, normal, normal)
        assert found == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize("ray", RAYS)
@pytest.mark.parametrize("beyond", [900.0, 25.0, -70.0, -2_000.0])
def test_an_eye_is_seen_at_its_globe_or_at_the_image_of_its_iris(ray, beyond):
    """All parts at once, along rays drawn from their ends: the place ``beyond`` the
    limbus, or within it.
    """
    p, tc, normal, d, (x, y) = refracted(*ray)
    r = np.sqrt(x * x + y * y + 1)
    limbus, pupil = r + beyond, r - 13.0 if beyond == 900 else min(r, r + beyond) - 500
    p[model.LIMBUS_R], p[model.PUPIL_R], p[model.LIMBUS_D] = (
        limbus,
        pupil,
        5_100 + 7_700 * (normal @ EYE[2]) - 30,
    )
    centre = p[model.CENTRE : model.CENTRE + 3].numpy()
    inside = smooth(30 / 80)
    along = centre @ d
    ts = along - np.sqrt(12_000.0**2 - centre @ centre + along**2)
    sphere = (ts * d - centre) / 12_000
    disc = inside * smooth(beyond / 240)
    hole = disc * smooth((pupil - r) / 40)
    vein = picture(
        T_VEIN, 190 * sphere @ EYE[0] + OFFSET[0], 190 * sphere @ EYE[1] + OFFSET[1]
    )
    ring = 1 - 0.25 * inside * bell(beyond / 1_300)
    albedo = 0.61 * (1 - 0.23 * vein) * ring
    corner = bell(((900 + 8_800) ** 2 + (1_400 - 500) ** 2) / 3.2e6, 3)
    albedo += (0.8 * 0.52 * (1 + 0.3 * vein) - albedo) * corner
    albedo += 0.12 * bell((2_600 - 120) / 150, 4)
    brown = pigment(x, y, r, pupil, max(limbus - pupil, 300))
    virtual = 1 / (1.376 / ray[2] - 0.376 / 7_700)
    light = shaded(
        albedo, brown, disc, hole, inside, 3_100, 2_600, ts, tc, sphere, normal, d
    )
    want = [light, (1 - disc) * ts + disc * (tc + virtual), hole]
    assert floats(model.eye(p, BANK, *tensors(900, 1_400, 3_100, 2_600, d))) == near(
        want
    )
