"""Areas on the job sheet are of shapes drawn either way round."""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.formats import handover

BOX = np.array([[0, 0], [300, 0], [300, 200], [0, 200]])


def test_clockwise_shapes_count_as_much_as_others():
    """Units of 2 nm: a box of 0.6 x 0.4 um; three and five pillars of two classes, and
    a figure of three boxes.
    """
    classes = [
        SimpleNamespace(polygons=[BOX], layer=(1, 0)),
        SimpleNamespace(polygons=[BOX[::-1], BOX], layer=(2, 0)),
    ]
    plan = SimpleNamespace(
        unit_nm=2.0,
        doses={(1, 0): 1.0, (7, 0): 1.0},
        classes=classes,
        counts=lambda: np.array([9, 3, 5]),
        figures=[
            SimpleNamespace(polygons={(1, 0): [BOX[::-1], BOX], (3, 0): [BOX[::-1]]})
        ],
    )
    found = handover.areas_um2(plan)
    assert found == {
        (1, 0): pytest.approx(5 * 0.24),
        (2, 0): pytest.approx(10 * 0.24),
        (3, 0): pytest.approx(0.24),
        (7, 0): 0.0,
    }
