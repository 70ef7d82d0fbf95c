"""The drawn module face by face: which part carries its name, what is seen through, and
that walls close.
"""

import json
import re
from collections import Counter

import numpy as np
import pytest

from metalens.chain import module_view


@pytest.fixture(scope="module")
def parts():
    text = str(module_view.view(aperture_mm=1.7, sensor_distance_mm=2.3))
    return json.loads(re.search(r"\[\{\"name\".*\}\]", text)[0])


def test_one_wall_of_the_mount_is_named_and_three_are_not(parts):
    assert [part["name"] for part in parts] == [
        "NIR filter", "substrate", "metalens", "mount", "", "", "", "sensor", "flex",
    ]  # fmt: skip


def test_glass_and_the_mount_are_seen_through_and_the_sensor_is_not(parts):
    told = {part["name"]: part["opacity"] for part in parts if part["name"]}
    assert told == {
        "NIR filter": 0.55,
        "substrate": 0.6,
        "metalens": 0.95,
        "mount": 0.28,
        "sensor": 1.0,
        "flex": 1.0,
    }
    assert {part["opacity"] for part in parts if not part["name"]} == {0.28}
    assert len({part["colour"] for part in parts if part["name"]}) == 6


def test_every_prism_is_closed(parts):
    """Six faces of four corners; each of the twelve edges borders two faces, each
    corner three.
    """
    for part in parts:
        if part["name"] == "metalens":
            continue
        assert [len(face) for face in part["faces"]] == [4] * 6
        edges = Counter(
            frozenset((tuple(face[k]), tuple(face[k - 1])))
            for face in part["faces"]
            for k in range(len(face))
        )
        assert len(edges) == 12
        assert set(edges.values()) == {2}


def test_walls_of_the_mount_meet_without_a_gap_or_an_overlap(parts):
    """Long ones along x at the ends of y, short ones between them: of an outside of 2.6
    and an inside of 2.24.
    """
    spans = [
        np.array(part["faces"][0])[:, :2]
        for part in parts
        if part["name"] in ("mount", "")
    ]
    boxes = [(*wall.min(0), *wall.max(0)) for wall in spans]
    o, i = 1.3, 1.12
    want = [(-o, -o, o, -i), (-o, i, o, o), (-o, -i, -i, i), (i, -i, o, i)]
    assert boxes == [pytest.approx(box, rel=1e-12) for box in want]


def test_the_rim_of_the_lens_has_forty_corners_and_comes_round_once(parts):
    ring = np.array(
        next(part for part in parts if part["name"] == "metalens")["faces"][0]
    )
    assert ring.shape == (40, 3)
    turns = np.unwrap(np.arctan2(ring[:, 1], ring[:, 0]))
    assert np.diff(turns) == pytest.approx(np.full(39, np.radians(9.0)), rel=1e-9)
    assert ring[:, 2] == pytest.approx(
        np.full(40, -0.001), rel=1e-12
    )  # below the glass, so that it is not hidden
