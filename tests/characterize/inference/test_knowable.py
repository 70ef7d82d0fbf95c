"""What frames can tell: combinations and their errors by hand, in the units of each
parameter.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import identifiability
from characterize.inference.asbuilt import AsBuilt
from characterize.model import PARAMETERS, PLACE

NAMES = ("bias_nm", "height_nm", "distance_um")
SCALE = np.array([PARAMETERS[PLACE[name]].scale for name in NAMES])
TURN = np.linalg.qr(np.array([[1.0, 0.4, 0.2], [-0.3, 1.0, 0.5], [0.1, -0.2, 1.0]]))[0]


def test_a_combination_is_told_where_frames_halve_what_was_known():
    """Values 4, 90 and 700 are known to 0.5, 0.105 and 0.038; a prior of 0.24 alone is
    halved by the latter two.
    """
    information = (TURN * [4.0, 90.0, 700.0]) @ TURN.T / np.outer(SCALE, SCALE)
    told = identifiability.identifiable_combinations(NAMES, information, 0.24 * SCALE)
    assert [line.rsplit(" to ", 1)[1] for line in told] == ["0.038", "0.11"]
    largest = int(np.abs(TURN[:, 2]).argmax())
    assert f"{NAMES[largest]}/{SCALE[largest]:g}" in told[0].split(" to ")[0]
    assert (
        len(
            identifiability.identifiable_combinations(
                NAMES, information, np.full(3, np.inf)
            )
        )
        == 3
    )
    assert (
        len(identifiability.identifiable_combinations(NAMES, information, 0.2 * SCALE))
        == 1
    )  # 0.105 is more than half of 0.2


def turned(main, others):
    """(p, p) orthogonal, its last column along ``main``."""
    return np.linalg.qr(np.column_stack([main, np.eye(len(main))[:, others]]))[0][
        :, ::-1
    ]


@pytest.mark.parametrize(("ratio", "told"), [(0.49, True), (0.51, False)])
def test_what_was_known_of_a_combination_adds_its_parts_as_variances(ratio, told):
    """Of u = 0.6 bias - 0.8 distance: √((0.6 x 0.3)² + (0.8 x 0.7)²) before, in units;
    half of that is needed after.
    """
    prior, along = np.array([0.3, 1.9, 0.7]), np.array([0.6, 0.0, -0.8])
    known = ratio * np.hypot(0.6 * 0.3, 0.8 * 0.7)
    turn = turned(along, [1, 0])
    values = np.array([0.1, 0.2, known**-2])
    found = identifiability.identifiable_combinations(
        NAMES, (turn * values) @ turn.T / np.outer(SCALE, SCALE), prior * SCALE
    )
    assert len(found) == told
    assert all(line.endswith(f" to {known:.2g}") for line in found)


def test_a_combination_without_a_prior_is_told_however_little_is_known():
    """Half of infinity is far off; eigenvalues below 1 count as they are."""
    for value in (0.04, 0.3):
        values, _ = identifiability.information_eigenvectors(
            NAMES, np.diag([value, 1.1, 2.3]) / SCALE**2
        )
        assert values == pytest.approx([value, 1.1, 2.3])
        found = identifiability.identifiable_combinations(
            NAMES, np.diag([value, 1.1, 2.3]) / SCALE**2, np.full(3, np.inf)
        )
        assert found[-1].rsplit(" to ", 1)[1] == f"{value**-0.5:.2g}"


def asbuilt(**more):
    """A record with the numbers of its posterior alone."""
    found = object.__new__(AsBuilt)
    numbers = {
        "names": NAMES,
        "value": np.array([1.1, -3.0, 8.0]),
        "covariance": np.array(
            [[0.09, -0.15, 0.0], [-0.15, 4.0, 3.0], [0.0, 3.0, 25.0]]
        ),
        "low": np.empty(0),
        "high": np.empty(0),
        "draws": np.empty((0, 0)),
        "design": b.row(wavelength_um=0.83, sensor_distance_um=4000.0),
    }
    for name, value in (numbers | more).items():
        object.__setattr__(found, name, value)
    return found


def test_intervals_samples_and_correlation_of_a_posterior():
    found = asbuilt()
    assert found.sigma == pytest.approx([0.3, 2.0, 5.0])
    assert found.correlation[[0, 1, 0], [1, 2, 2]] == pytest.approx([-0.25, 0.3, 0.0])
    assert found.interval("height_nm") == pytest.approx(
        (-3.0 - 1.959964 * 2, -3.0 + 1.959964 * 2)
    )
    drawn = found.samples(60_000, seed=1)
    assert drawn.mean(0) == pytest.approx(found.value, abs=0.1)  # 5 / sqrt(6e4) = 0.02
    error = abs(np.cov(drawn.T) - found.covariance) / np.outer(found.sigma, found.sigma)
    assert error.max() < 0.03  # sqrt(2 / 6e4) = 0.006
    bent = asbuilt(
        low=np.array([0.1, -9.0, 2.0]),
        high=np.array([1.9, 7.0, 9.0]),
        draws=np.arange(12.0).reshape(4, 3),
    )
    assert bent.interval("height_nm") == (-9.0, 7.0)
    again = bent.samples(10, seed=2)
    counts = [(again == row).all(1).sum() for row in bent.draws]
    assert sorted(counts) == [2, 2, 3, 3]  # each once before any comes again
