"""Classes of maps and places of sliders by hand, and what does not fit together."""

import math

import numpy as np
import pytest

from metalens.ground.errors import StoreError
from metalens.view.panels import Axis, Classes, Images, Points, at_brightest, classes_of


def test_sliders_stand_at_the_brightest_image():
    values = np.zeros((3, 4, 5, 6))
    values[2, 1, 4, 3] = 7.0
    values[1, 3, 0, 0] = 6.9
    axes = [Axis("a", [1, 2, 3], "nm", blink=True), Axis("b", list("wxyz"))]
    found = at_brightest(axes, values)
    assert [one.first for one in found] == [2, 1]
    assert (found[0].name, found[0].values, found[0].unit, found[0].blink) == (
        "a",
        [1, 2, 3],
        "nm",
        True,
    )
    assert [one.first for one in axes] == [0, 0]
    assert Axis("c", []).blink is False


def test_few_sizes_are_classes_of_their_own_from_one_on():
    index, kinds = classes_of(np.array([[0.2, 0.0, 0.1], [0.1, 0.15, 0.2]]))
    assert index.tolist() == [[3, 0, 1], [1, 2, 3]]
    assert kinds.tolist() == [0.1, 0.15, 0.2]
    assert index.dtype == np.uint8


@pytest.mark.parametrize(("count", "kind"), [(255, np.uint8), (256, np.uint16)])
def test_classes_that_a_byte_cannot_hold_take_two(count, kind):
    index, kinds = classes_of(np.arange(count + 1.0).reshape(1, -1))
    assert index.dtype == kind
    assert index.ravel().tolist() == list(range(count + 1))
    assert len(kinds) == count


def test_more_sizes_than_classes_go_to_the_nearest_of_equal_steps():
    """Four classes from 1 to 4: steps of 1; five distinct values are one too many."""
    values = np.array([[1.0, 1.4, 2.6], [3.4, 0.0, 4.0]])
    index, kinds = classes_of(values, most=4)
    assert kinds.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert index.tolist() == [[1, 1, 3], [3, 0, 4]]
    index, kinds = classes_of(values, most=5)
    assert kinds.tolist() == [1.0, 1.4, 2.6, 3.4, 4.0]
    assert index.tolist() == [[1, 2, 3], [4, 0, 5]]
    many = np.arange(1.0, 65_537.0)  # one more than there are classes
    index, kinds = classes_of(many)
    assert len(kinds) == 65_535
    assert (kinds[0], kinds[-1]) == (1.0, 65_536.0)
    assert np.abs(kinds[index - 1] - many).max() <= 0.5 * (65_535 / 65_534) + 1e-9


def test_what_does_not_fit_together_is_refused():
    Images("a", np.zeros((3, 2, 4, 5)), [Axis("x", [1, 2, 3]), Axis("y", [1, 2])], 0.3)
    for shape in ((3, 4, 5), (2, 3, 4, 5), (3, 2, 1, 4, 5)):
        with pytest.raises(
            StoreError, match=r"a: sliders \(3, 2\) do not fit images of shape"
        ):
            Images("a", np.zeros(shape), [Axis("x", [1, 2, 3]), Axis("y", [1, 2])], 0.3)
    Classes("b", np.array([[0, 3]]), np.ones(3), 0.4, "nm")
    Classes("b", np.empty((0, 2), int), np.ones(0), 0.4, "nm")
    with pytest.raises(StoreError, match="b: class 4 of 3"):
        Classes("b", np.array([[0, 4]]), np.ones(3), 0.4, "nm")
    Points("c", [1.0, 2.0], [3.0, 4.0], "x", "y", ["g", "h"])
    Points("c", [1.0, 2.0], [3.0, 4.0], "x", "y", ["g", "h"], notes=[{}, {}])
    for more in ({"x": [1.0]}, {"y": [3.0, 4.0, 5.0]}, {"groups": ["g"]}, {"notes": [{}]}, {"x": [1.0, math.inf]},
                 {"y": [3.0, math.nan]}):  # fmt: skip
        good = {"x": [1.0, 2.0], "y": [3.0, 4.0], "groups": ["g", "h"]}
        with pytest.raises(
            StoreError, match="c: need as many finite x, finite y, groups and notes"
        ):
            Points("c", x_name="x", y_name="y", **(good | more))
