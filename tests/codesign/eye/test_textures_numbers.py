"""Pictures of the eye's parts on noise that is typed in, and hairs and vessels as they
are drawn.
"""

import math

import numpy as np
import pytest

from codesign.eye import textures

RNG = np.random.default_rng(7)


class Drawn:
    """A generator that answers its list in turn, each within what it was asked for."""

    def __init__(self, *answers):
        self.answers, self.asked = list(answers), []

    def _next(self, *asked):
        self.asked.append(asked)
        return self.answers.pop(0)

    def uniform(self, low, high, size=None):
        found = self._next("uniform", low, high)
        assert (np.asarray(found) >= low).all()
        assert (np.asarray(found) <= high).all()
        return found if size is None else np.asarray(found)

    def integers(self, low, high):
        found = self._next("integers", low, high)
        assert low <= found < high
        return found


@pytest.fixture
def noises(monkeypatch):
    """Fields in place of noise, with what was asked for."""
    asked, fields = [], {}

    def noise(rng, *, power, stretch=1.0, shape=(textures.SIZE, textures.SIZE)):
        asked.append((power, stretch, shape))
        return fields.setdefault(len(asked), RNG.normal(size=shape))

    monkeypatch.setattr(textures, "periodic_noise", noise)
    return asked, fields


def test_skin_is_blotches_and_folds(noises):
    asked, fields = noises
    got = textures._skin(None)
    assert asked == [(1.4, 1.0, (256, 256)), (1.1, 4.0, (256, 256))]
    assert np.abs(got - np.tanh(0.6 * fields[1] + 0.5 * fields[2])).max() < 1e-12


def test_fine_structure_is_pores_and_lines(noises):
    asked, fields = noises
    got = textures._fine(Drawn(1.3))
    assert asked == [(0.8, 1.0, (256, 256)), (1.1, 1.3, (256, 256))]
    assert (
        np.abs(got - np.tanh(0.5 * fields[1] + 0.9 * (np.abs(fields[2]) - 0.8))).max()
        < 1e-12
    )


def test_an_iris_is_its_polar_picture_from_the_pupil_to_the_limbus(noises, monkeypatch):
    """Fibres, clouds, collarette, a furrow and three crypts in 96 rings of 1024; margin
    at 40 pixels, limbus at 124.
    """
    asked, fields = noises
    crypts = iter([0.1, 0.2, 0.05])
    monkeypatch.setattr(
        textures, "_crypt", lambda rng, rho, turns: next(crypts) * np.ones((96, 1024))
    )
    rng = Drawn(7.0, 1, [0.7], 0.8, 0.35, 3)
    got = textures._iris(rng)
    assert [one[1:] for one in rng.asked] == [
        (5, 11),
        (1, 4),
        (0.55, 0.9),
        (0.3, 0.9),
        (0, 0.6),
        (3, 14),
    ]
    assert asked == [
        (0.7, 7.0, (192, 1024)), (1.4, 2.0, (192, 1024)), (1.2, 1.0, (4, 1024)), (1.5, 1.0, (4, 1024)),
    ]  # fmt: skip
    rho = (np.arange(96) / 95)[:, None]
    ring = np.exp(-(((rho - 0.28 - 0.05 * np.tanh(fields[3][:1])) / 0.045) ** 2))
    furrow = np.exp(-(((rho - 0.7 - 0.02 * np.tanh(fields[4][:1])) / 0.016) ** 2))
    polar = (
        0.6 * np.tanh(0.9 * fields[1][:96])
        + 0.35 * fields[2][:96]
        + 0.8 * ring
        - 0.35 * furrow
        - 0.35
    )
    polar = np.tanh(polar)
    for y, x in (
        (128, 128),
        (128, 128 + 83),
        (60, 190),
        (128 - 100, 128 + 3),
        (250, 7),
    ):
        away, turn = (
            math.hypot(y - 128, x - 128),
            math.atan2(y - 128, x - 128) / (2 * math.pi) % 1,
        )
        row, column = min(max((away - 40) / 84, 0), 1) * 95, turn * 1024
        r, c = int(row), int(column)
        below, right, t, s = min(r + 1, 95), (c + 1) % 1024, row - r, column - c
        want = (polar[r, c] * (1 - s) + polar[r, right] * s) * (1 - t)
        want += (polar[below, c] * (1 - s) + polar[below, right] * s) * t
        assert got[y, x] == pytest.approx(want)


def test_a_crypt_is_a_lozenge_with_a_soft_border():
    """Half as deep where |rho - at| / height + |turn| / width is 1; whole inside; the turn wraps."""
    rho = np.linspace(0, 1, 201)[:, None]
    rng = Drawn(0.4, 0.995, 0.1, 0.0125, 1.2)
    got = textures._crypt(rng, rho, 800)
    assert [one[1:] for one in rng.asked] == [
        (0.32, 0.6),
        (0, 1),
        (0.05, 0.13),
        (0.006, 0.018),
        (0.6, 1.3),
    ]
    assert got[80, 796] == pytest.approx(1.2 / (1 + math.exp(-6)))
    assert got[100, 796] == pytest.approx(0.6)
    assert got[80, 6] == pytest.approx(
        0.6
    )  # 10 of 800 turns to the other side of the seam
    assert got[90, 791] == pytest.approx(0.6)
    assert got[120, 796] == pytest.approx(1.2 / (1 + math.exp(6)))


def test_values_between_pixels_wrap_along_the_turn_and_stop_at_the_rim():
    picture = RNG.normal(size=(4, 6))
    row, column = np.array([[0.0, 1.25, 3.0]]), np.array([[2.0, 5.5, 5.75]])
    got = textures._bilinear(picture, row, column)[0]
    assert got[0] == picture[0, 2]
    assert got[1] == pytest.approx(
        0.75 * (picture[1, 5] + picture[1, 0]) / 2
        + 0.25 * (picture[2, 5] + picture[2, 0]) / 2
    )
    assert got[2] == pytest.approx(0.25 * picture[3, 5] + 0.75 * picture[3, 0])


def test_pixels_are_kept_with_their_right_neighbours():
    bank = textures.texture_bank(0)
    assert bank.shape == (5 * 16, 256, 256)
    assert np.abs(bank).max() <= 1
    steps = np.round(bank.astype(float) * 32767).astype(int)
    assert np.abs(bank - steps / 32767).max() < 1e-7
    words = textures.packed_bank(0).reshape(bank.shape)
    here, right = (words << 16) >> 16, words >> 16
    assert np.array_equal(here, steps)
    assert np.array_equal(right, np.roll(steps, -1, axis=2))
    lashes = bank[4 * 16 :]
    assert not lashes[
        :, -6:
    ].any()  # the last rows are empty, but for a blur of 0.7 pixels
    assert lashes[:, :40].mean() > 3 * lashes[:, 160:200].mean()  # hairs taper and end
    veins = bank[16 : 2 * 16]
    assert veins.min() >= 0
    assert 0.005 < (veins > 0.1).mean() < 0.2


def test_a_vessel_goes_on_by_two_pixels_a_step():
    """Straight ahead along +x: 30 steps from (5, 40), as bright as 1.4 times its width."""

    class Straight:
        def normal(self, mean, sigma):
            assert (mean, sigma) == (0, 0.22)
            return 0.0

        def random(self):
            return 0.5

    canvas = np.zeros((80, 90), np.uint8)
    textures._vessel(
        canvas, Straight(), np.array([5.0, 40.0]), 0.0, width=0.5, length=30, depth=2
    )
    rows, columns = np.nonzero(canvas > 100)
    assert (columns.min(), columns.max()) == pytest.approx(
        (5, 65), abs=1
    )  # ends are drawn fainter
    assert set(rows.tolist()) == {40}
    assert canvas[40, 30] == pytest.approx(255 * 0.7, rel=0.15)  # smoothed across
    wide = np.zeros((80, 90), np.uint8)
    textures._vessel(
        wide, Straight(), np.array([5.0, 40.0]), 0.0, width=0.8, length=30, depth=0
    )
    assert wide[40, 30] > 255 * 0.85


def test_vessels_begin_at_both_sides_and_head_inwards(monkeypatch):
    """Within some half radians of straight in: of 200 pictures' vessels the mean cosine
    is exp(-1/8) = 0.88.
    """
    begun = []
    monkeypatch.setattr(
        textures,
        "_vessel",
        lambda canvas, rng, at, heading, **about: begun.append((*at, heading)),
    )
    rng = np.random.default_rng(5)
    for _ in range(200):
        textures._veins(rng)
    x, y, heading = np.array(begun).T
    assert set(x.tolist()) == {0.0, float(textures.SIZE)}
    assert (
        0
        <= y.min()
        < 0.01 * textures.SIZE
        < 0.99 * textures.SIZE
        < y.max()
        <= textures.SIZE
    )
    inwards = np.where(x == 0, np.cos(heading), -np.cos(heading))
    assert len(x) > 1000
    for side in (x == 0, x > 0):
        assert inwards[side].mean() == pytest.approx(
            np.exp(-1 / 8), abs=0.03
        )  # of 800, each within 0.15 rms: 0.005
