"""What frames have is drawn cause by cause, and by person where a person wears it."""

import itertools

import numpy as np

from codesign.eye import appearance


def test_causes_share_no_draw():
    """Correlation of two causes' places over 4000 frames: four sigma of 1 / √n."""
    found = appearance.draw_augmentations(4000, 2.0, np.random.default_rng(7))
    for one, other in itertools.combinations(appearance.CAUSES, 2):
        a, b = found.draws[one], found.draws[other]
        a, b = ((c - c.mean(0)) / c.std(0) for c in (a, b))
        # 144 places a pair, 300 pairs: the largest of 4e4 normal draws is 4.6 sigma
        assert np.abs(a.T @ b).max() / 4000 < 5.5 / np.sqrt(4000), (one, other)


def test_the_light_s_direction_says_nothing_of_the_rim_s():
    found = appearance.draw_augmentations(4000, 4.0, np.random.default_rng(1))
    both = (found.size["gradient"] > 0) & (found.size["rim"] > 0)
    turns = [6.283 * found.draws[name][both, 7] for name in ("gradient", "rim")]
    assert both.sum() > 300
    mean = np.exp(1j * (turns[0] - turns[1])).mean()
    assert abs(mean) < 4 / np.sqrt(both.sum())


def test_a_person_keeps_spectacles_from_frame_to_frame():
    who = np.repeat(np.arange(40), 5)
    found = appearance.drawn_of_people(who, 3.0, (4, 5))
    for name in ("rim", "liner", "reflection"):
        size = found.size[name].reshape(40, 5)
        assert (size == size[:, :1]).all()
        assert 0 < (size[:, 0] > 0).mean() <= 1
    moved = found.size["movement"].reshape(40, 5)
    assert (moved != moved[:, :1]).any()
