"""How far an STL may be off before it is told: pillars moved, thinned and cut by known
amounts.
"""

import struct

import numpy as np
import pytest

from layout.solid import mesh, readback
from layout.solid.tile import Tile

PLACES = np.array([[31.3, -47.1], [31.9, -46.5], [30.7, -46.9]])
# of three pillars about (31.3, -46.8) um: one of 0.24 um and two of 0.15


def tile():
    size = np.array([0.15, 0.24])
    return Tile(size, size, PLACES[:, 0], PLACES[:, 1], np.array([0, 1, 0]), 0.7, 0.4)


@pytest.fixture
def written(tmp_path):
    """(write a copy with its corners changed, and what is told of it)."""
    path = tmp_path / "a.stl"
    mesh.write_stl(path, tile())
    whole = path.read_bytes()

    def told(change, pillars=None):
        data = bytearray(whole)
        corners = np.frombuffer(data, mesh.STL, offset=84)["corners"]
        corners[:] = change(corners.astype(float))
        path.write_bytes(data)
        return readback.stl_differences(path, tile() if pillars is None else pillars)

    return told


@pytest.mark.parametrize(
    ("axis", "sign"), [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)]
)
def test_the_box_agrees_to_two_steps_of_single_precision(written, axis, sign):
    """From 32 to 64 um such a step is 2^-18 um, 3.8e-6; two of them and 1e-6 um are
    8.6e-6.
    """
    move = np.zeros(3)
    move[axis] = sign
    assert written(lambda c: c) == ()
    assert written(lambda c: c + 3.8e-6 * move) == ()
    (text,) = written(lambda c: c + 16e-6 * move)
    assert text.startswith("the box around it is 1.")


def test_volumes_agree_to_what_single_precision_leaves(written):
    """2e-6, and a step of 3.8e-6 um over the 0.077 um that the thinnest pillar's
    corners reach: 5.2e-5.
    """

    def thinner(part):
        """All pillars, about their own middles, along x: their volume is less by this
        part.
        """

        def change(c):
            each = c.reshape(3, -1, 3, 3).copy()
            each[..., 0] = (each[..., 0] - PLACES[:, 0, None, None]) * (
                1 - part
            ) + PLACES[:, 0, None, None]
            return each.reshape(c.shape)

        return change

    assert written(thinner(1.5e-5)) == ()
    told = written(thinner(3e-4))
    assert [t.partition(" ")[0] for t in told if t.startswith("volume")] == ["volume"]


def test_the_volume_that_was_planned_is_told(written):
    """Prisms of the area of their circles: 0.7 pi (0.24² + 2 x 0.15²) / 4; half as high
    here.
    """
    told = written(lambda c: c * [1, 1, 0.5])
    volume = 0.7 * np.pi * (0.24**2 + 2 * 0.15**2) / 4
    assert told[0] == "the box around it is 0.35 um off"
    found, planned = (
        float(w.strip(",")) for w in (told[1].split()[1], told[1].split()[4])
    )
    assert planned == pytest.approx(volume, rel=1e-8)  # nine digits
    assert found == pytest.approx(
        volume / 2, rel=1e-4
    )  # single precision 40 um off the origin


@pytest.mark.parametrize("chunk", [1, 2, 1 << 16])
def test_pieces_of_a_file_are_its_whole(written, monkeypatch, chunk):
    monkeypatch.setattr(readback, "_CHUNK", chunk)
    assert written(lambda c: c) == ()

    for pillar in (1, 2):

        def moved(c, pillar=pillar):
            each = c.reshape(3, -1, 3, 3).copy()
            each[pillar] += np.array([0.01, 0, 0])
            return each.reshape(c.shape)

        assert written(moved) == ("the box around it is 0.01 um off",)


def test_a_file_says_its_triangles_and_is_as_long_as_they_are(tmp_path):
    """28 triangles of 50 bytes for a prism of eight sides, behind 84 bytes."""
    path = tmp_path / "a.stl"
    path.write_bytes(bytes(80) + struct.pack("<I", 84) + bytes(84 * 50 - 1))
    assert readback.stl_differences(path, tile()) == (
        "84 triangles in 4283 bytes, planned 84",
    )
    path.write_bytes(bytes(80) + struct.pack("<I", 83) + bytes(84 * 50))
    assert readback.stl_differences(path, tile()) == (
        "83 triangles in 4284 bytes, planned 84",
    )
    path.write_bytes(bytes(83))
    assert readback.stl_differences(path, tile()) == (
        "-1 triangles in 83 bytes, planned 84",
    )
