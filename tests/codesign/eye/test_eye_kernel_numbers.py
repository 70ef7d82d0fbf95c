"""The compiled picture of one plane, one sphere and one lamp: ray by ray in closed
form, over tiles and beyond them.

Pictures of texture are even, so what is left is a lit plane (the face), a lit ball (the
globe, its cornea turned away)
and the soft edge of a lid between them. 37 columns are two tiles and five lanes, six
rows a tile and a half.
"""

import numpy as np
import pytest

from codesign.eye import kernel, model
from codesign.eye.textures import SIZE

BANK = np.zeros(SIZE * SIZE, np.int32)
U, W = np.linspace(-0.3, 0.28, 37), np.linspace(-0.22, 0.25, 6)
OUT = np.array([0.12, -0.16, -np.sqrt(0.96)])
RIGHT = np.array([np.sqrt(0.96), 0.0, 0.12]) / np.sqrt(0.9744)
DOWN = np.cross(OUT, RIGHT)
PLACE = np.array([200.0, -300.0, 20_000.0])  # on the face; the eye is 14 mm behind it
CENTRE = PLACE - 14_000 * OUT
LAMP = np.array([6e3, -4e3, 2e3])
NUMBERS = {
    "SCLERA_R": 12_000, "CORNEA_R": 7_700, "CORNEA_D": 5_100, "LIMBUS_R": 5_800, "LIMBUS_D": 9_900, "PUPIL_R": 1_900,
    "PUPIL_D": 9_300, "INDEX": 1.376, "LID_R": 5_000, "BLEND": 1_600, "EDGE": 1_500, "LOWER": 1e6, "HALF": 1e9,
    "CREASE": 1e6, "SKIN": 0.52, "SCLERA": 0.61, "PUPIL": 0.03, "GLINT": 0.8, "AMBIENT": 0.31, "GAIN": 1.7,
    "CARUNCLE": 1e6,
}  # fmt: skip
VECTORS = {
    "CENTRE": CENTRE, "FACE_X": RIGHT, "FACE_Y": DOWN, "FACE_Z": OUT, "AXIS": [0, 0, 1], "IRIS_X": [1, 0, 0],
    "IRIS_Y": [0, 1, 0], "PLANE": PLACE, "LED": [*LAMP, 1e9, 0, 0, 0, 1e9, 0],
}  # fmt: skip


def parameters(**changed):
    """(COUNT,) with one lamp near; the other two are a kilometre away."""
    p = np.zeros(model.COUNT)
    for name, value in (VECTORS | NUMBERS | changed).items():
        place, values = getattr(model, name), np.atleast_1d(value)
        p[place : place + len(values)] = values
    return p


def lit(point, normal, wrap):
    v = LAMP - point
    far = np.sqrt(v @ v + 1e6)
    ambient = 0.31 * (0.6 - 0.4 * normal @ DOWN)
    return max(v @ normal / far + wrap, 0) * (20_000 / far) ** 2 / (1 + wrap) + ambient


def shine(point, normal, d):
    """Of the near lamp, and of the one straight right."""
    total, v = 0.0, LAMP - point
    for way in (v / np.sqrt(v @ v + 1e6), np.array([1.0, 0.0, 0.0])):
        half = way - d
        total += (
            1 + 125 * (1 - max(half @ normal, 0) ** 2 / (half @ half + 1e-3))
        ) ** -2
    return total


def seen(u, w, centre=CENTRE, plane=PLACE, lid=0.0):
    """Light of face and eye, share of the eye, distance of both along z: of one ray."""
    d = np.array([u, w, 1]) / np.sqrt(u * u + w * w + 1)
    face = plane @ OUT / (d @ OUT) * d
    gy = (face - centre) @ DOWN
    upper, lower = gy + lid, 1e6 - gy
    t = np.clip(0.5 + upper / 3_000, 0, 1)
    share = t * t * (3 - 2 * t)
    normal = OUT / np.sqrt(1 + 1e-6)
    skin = (
        0.52
        * (1 - 0.25 / (1 + ((upper + 250) / 260) ** 2))
        * (1 - 0.42 / (1 + ((upper + 1e6) / 260) ** 2))
    )
    near = skin * lit(face, normal, 0.35) * 1.7
    along = centre @ d
    far = along - np.sqrt(max(12_000**2 - centre @ centre + along**2, 1e6))
    ball = far * d
    out = (ball - centre) / 12_000
    shadow = 1 - 0.5 / (1 + max(upper, 0) / 900) ** 2 - 0.15 / (1 + lower / 500)
    white = 0.61 * lit(ball, out, 0.3) * shadow + 0.8 * shine(ball, out, d)
    return np.array([near * (1 - share), white * 1.7 * share, share, face[2], ball[2]])


def picture(**changed):
    """(5, y, x)."""
    return np.moveaxis(np.array([[seen(u, w, **changed) for u in U] for w in W]), -1, 0)


def rendered(frames, scale):
    shape = len(frames), 2, len(W), len(U)
    light, cover, depth = (np.full(shape, np.nan, np.float32) for _ in range(3))
    pupil = np.full((len(frames), 1, *shape[2:]), np.nan, np.float32)
    given = (np.array(a, np.float32) for a in (frames, scale))
    kernel.render(
        *given,
        BANK,
        U.astype(np.float32),
        W.astype(np.float32),
        light,
        cover,
        depth,
        pupil,
    )
    return light, cover, depth, pupil


def test_a_plane_a_ball_and_the_edge_of_a_lid_are_lit_by_one_lamp():
    """Frames of which the first is half face, half eye, the second face alone, the
    third eye alone, as large as their
    scales: depths are multiplied by them. float32: a fifth of a micrometre per 10 mm of
    depth, and 5e-4 of the light
    where a ray grazes the ball and the root of a difference halves the digits.
    Tiles in which there is no eye have no depth of it."""
    lids, scale = (0.0, -1e6, 1e6), (1.0, 1.25, 0.8)
    light, cover, depth, pupil = rendered(
        [parameters(UPPER=lid) for lid in lids], scale
    )
    for k, lid in enumerate(lids):
        near, far, share, front, back = picture(lid=lid)
        np.testing.assert_allclose(cover[k], [1 - share, share], atol=1e-5)
        np.testing.assert_allclose(light[k], [near, far], rtol=5e-4, atol=1e-5)
        np.testing.assert_allclose(depth[k, 0], scale[k] * front, rtol=2e-5)
        shown = share > 1e-6
        np.testing.assert_allclose(
            depth[k, 1][shown], scale[k] * back[shown], rtol=2e-5
        )
    assert not light[1, 1].any()
    assert not depth[1, 1].any()
    assert not light[2, 0].any()
    assert not pupil.any()


def test_the_pupil_is_seen_at_its_image_on_the_axis_of_an_eye_that_looks_along_a_ray():
    """The cornea's apex is 34 - 12.8 mm away, the pupil 3.5 mm behind it: 1/s' =
    1.376/3.5 - 0.376/7.7 per mm.
    """
    row, column = 4, 19
    d = np.array([U[column], W[row], 1.0])
    d /= np.linalg.norm(d)
    across = np.array([d[2], 0, -d[0]]) / np.hypot(d[0], d[2])
    p = parameters(
        CENTRE=34_000 * d, AXIS=-d, IRIS_X=across, IRIS_Y=np.cross(-d, across), UPPER=1e6, EDGE=40.0, IRIS=0.37,
        PLANE=15_000 * d,
    )  # fmt: skip
    light, cover, depth, pupil = rendered([p], [1.1])
    virtual = 1 / (1.376 / 3_500 - 0.376 / 7_700)
    assert pupil[0, 0, row, column] == pytest.approx(1, abs=1e-4)
    assert cover[0, 1].min() == pytest.approx(1, abs=1e-6)
    assert depth[0, 1, row, column] == pytest.approx(
        1.1 * (21_200 + virtual) * d[2], rel=2e-5
    )
    assert light[0, 1, row, column] >= 1.7 * 0.03 * 0.99
    reach = np.hypot(*(34_000 * np.array(np.meshgrid(U - U[column], W - W[row]))))
    assert not pupil[0, 0][reach > 6_000].any()
    assert pupil[0, 0].sum() > 5  # of the row: 0.6 mm apart, a pupil 4.3 mm wide


MOVES = [
    {"UPPER": 1.0},
    {"CENTRE": np.array([0.3, -0.5, 0.8]), "PLANE": np.array([-0.2, 0.4, 0.9])},
]


def test_two_tangents_are_the_limits_of_differences():
    """Lid, eye and face moved by micrometres: slopes of the closed form, taken over 2
    um in double precision; in
    float32 to 1e-3 of the largest. On the rim of the ball depth has no slope."""
    packed = []
    for lid in (0.0, 700.0):
        tangents = [np.zeros(model.COUNT) for _ in MOVES]
        for tangent, move in zip(tangents, MOVES, strict=True):
            for name, value in move.items():
                place, values = getattr(model, name), np.atleast_1d(value)
                tangent[place : place + len(values)] = values
        packed.append([parameters(UPPER=lid), *tangents])
    out = np.full((2, 15, len(W), len(U)), np.nan, np.float32)
    kernel.differentiate(
        np.array(packed, np.float32),
        BANK,
        U.astype(np.float32),
        W.astype(np.float32),
        out,
    )
    for k, lid in enumerate((0.0, 700.0)):
        want = picture(lid=lid)
        shown = want[2] > 1e-6
        np.testing.assert_allclose(out[k, :3], want[:3], rtol=5e-4, atol=1e-5)
        np.testing.assert_allclose(out[k, 3], want[3], rtol=2e-5)
        np.testing.assert_allclose(out[k, 4][shown], want[4][shown], rtol=2e-5)
        for at, move in enumerate(MOVES, 1):
            ahead, behind = (
                picture(
                    lid=lid + h * move.get("UPPER", 0.0),
                    centre=CENTRE + h * move.get("CENTRE", 0.0),
                    plane=PLACE + h * move.get("PLANE", 0.0),
                )
                for h in (1.0, -1.0)
            )
            slope = (ahead - behind) / 2
            found = out[k, 5 * at : 5 * at + 5]
            for part in range(4):
                room = 1e-3 * np.abs(slope[part]).max() + 1e-9
                np.testing.assert_allclose(
                    found[part], slope[part], rtol=2e-3, atol=room
                )
            inner = shown & (ball_depth() > 4_000)
            np.testing.assert_allclose(
                found[4][inner], slope[4][inner], rtol=2e-3, atol=1e-4
            )


def ball_depth():
    """Half chords of the globe, 0 where a ray passes by."""
    d = np.stack([*np.meshgrid(U, W), np.ones((len(W), len(U)))], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return np.sqrt(np.maximum(12_000**2 - CENTRE @ CENTRE + (d @ CENTRE) ** 2, 0))


def test_rays_of_a_tile_run_along_its_rows_and_its_rim_is_repeated():
    """A tile of two rows of 16 from row 2 and column 5 of a frame of three rows and
    eight columns.
    """
    u, w, x = np.arange(10.0, 18.0), np.array([0.1, 0.2, 0.3]), np.zeros(80)
    kernel._aim.py_func(u, w, 2, 5, x, 40, 2)
    row = [15, 16, *[17] * 14]
    assert x[:40].tolist() == [*row, *row, *[0] * 8]
    assert x[40:].tolist() == [*[0.3] * 32, *[0] * 8]


@pytest.mark.parametrize(("row", "column"), [(1, 2), (0, 4), (2, 19)])
def test_the_part_of_a_tile_that_lies_in_the_frame_is_put_there(row, column):
    """Two rows of 16 lanes from lane 3 into plane (1, 0) of frames of three rows and
    twenty columns.
    """
    x, out = np.arange(3.0, 43.0), np.full((2, 2, 3, 20), -1.0)
    kernel._put.py_func(x, 3, 2, out, 1, 0, row, column)
    want = np.full((2, 2, 3, 20), -1.0)
    for j in range(2):
        for i in range(16):
            if row + j < 3 and column + i < 20:
                want[1, 0, row + j, column + i] = 6 + 16 * j + i
    np.testing.assert_array_equal(out, want)


def test_least_and_most_of_the_lanes_of_a_name():
    x = np.array([-9.0, 4.0, 2.0, 7.0, 3.0, 11.0])
    for first, value in ((1, (2, 7)), (2, (2, 7))):
        assert (
            kernel._least.py_func(x, first, 3),
            kernel._most.py_func(x, first, 3),
        ) == value
    assert (kernel._least.py_func(x, 0, 6), kernel._most.py_func(x, 0, 6)) == (-9, 11)
