"""What frames have is drawn cause by cause, and by person where a person wears it."""

import numpy as np

from codesign.eye import appearance


def test_a_person_keeps_spectacles_from_frame_to_frame():
    who = np.repeat(np.arange(40), 5)
    found = appearance.drawn_of_people(who, 3.0, (4, 5))
    for name in ("rim", "liner", "reflection"):
        size = found[name][:, 0].reshape(40, 5)
        assert (size == size[:, :1]).all()
        assert 0 < (size[:, 0] > 0).mean() <= 1
    moved = found["movement"][:, 0].reshape(40, 5)
    assert (moved != moved[:, :1]).any()
