"""The sampled error of a window: without bias, against the sum over all of its pixels."""

import numpy as np
import pytest

from metalens.propagate import estimate

SHAPE = (9, 13)


def light(seed=0, depths=3):
    """Normalised intensities, and errors δ/S of them that are not small where the light
    is.
    """
    rng = np.random.default_rng(seed)
    y, x = (np.arange(n) - c for n, c in zip(SHAPE, (3.1, 7.4), strict=True))
    spot = np.exp(-(y[:, None] ** 2 / 5 + x**2 / 11)).ravel() + 0.02
    value = spot * rng.uniform(0.6, 1.4, (depths, spot.size))
    value /= value.sum(1, keepdims=True)
    return value, value * (0.03 + 0.1 * rng.standard_normal(value.shape))


def exact(value, delta):
    """Σ (δ/S - (I/S) Σ δ/S)² over all pixels and depths."""
    return ((delta - value * delta.sum(1, keepdims=True)) ** 2).sum()


def test_with_every_pixel_it_is_the_sum_itself():
    value, delta = light()
    points, chance = estimate.draw_pixels(
        value, estimate.morton_scan(SHAPE), 3 * value.shape[1]
    )
    assert (chance == 1).all()
    assert estimate.square_error(value, points, chance, delta) == pytest.approx(
        exact(value, delta), rel=1e-12
    )


def test_drawn_pixels_give_it_without_bias():
    """Independent draws with the stated chances: the mean of 4000 estimates is the sum
    over all pixels.
    """
    value, delta = light(1)
    rng, n = np.random.default_rng(2), 16
    density = 0.5 * value + 0.5 / value.shape[1]
    found = []
    for _ in range(4000):
        points = np.stack([rng.choice(value.shape[1], n, p=row) for row in density])
        chance = np.take_along_axis(density, points, 1)
        found.append(
            estimate.square_error(
                value, points, chance, np.take_along_axis(delta, points, 1)
            )
        )
    # scatter of one estimate 0.35 of it: 0.006 for the mean; the floor at 3 % of the
    # plain part is rarely reached
    assert np.mean(found) == pytest.approx(exact(value, delta), rel=0.03)


def test_a_systematic_draw_follows_the_light_and_its_root():
    value = light(3, depths=1)[0]
    points, chance = estimate.draw_pixels(value, estimate.morton_scan(SHAPE), 40)
    root = np.sqrt(value) / np.sqrt(value).sum()
    density = (value + root) / 2
    assert points.shape == (1, 40)
    assert chance == pytest.approx(np.take_along_axis(density, points, 1), rel=1e-12)
    counts = np.bincount(points[0], minlength=value.shape[1])
    assert (
        np.abs(counts - 40 * density[0]).max() < 1 + 1e-9
    )  # systematic: never off by more than one


def test_the_scan_goes_through_a_window_in_z_order():
    order = estimate.morton_scan((4, 4))
    assert order.tolist() == [0, 1, 4, 5, 2, 3, 6, 7, 8, 9, 12, 13, 10, 11, 14, 15]


def test_products_of_sums_are_taken_over_pairs_of_unlike_draws():
    """Three draws of five pixels by loops: a sum over i ≠ j of b_i d_j has the mean of
    the product of both sums.
    """
    value = np.array([[0.1, 0.3, 0.25, 0.15, 0.2]])
    points, chance = np.array([[1, 3, 4]]), np.array([[0.3, 0.1, 0.25]])
    d = np.array([0.02, -0.013, 0.031])
    part = value[0, points[0]]
    alone = np.mean(d**2 / chance[0])
    cross = common = 0.0
    for i in range(3):
        for j in range(3):
            if i != j:
                cross += part[i] * d[i] / chance[0, i] * d[j] / chance[0, j] / 6
                common += d[i] / chance[0, i] * d[j] / chance[0, j] / 6
    want = alone - 2 * cross + common * (value**2).sum()
    assert want > 0.03 * alone
    assert estimate.square_error(value, points, chance, d[None]) == pytest.approx(
        want, rel=1e-12
    )
    even = (
        np.array([[0.02, 0.02 / 3, 0.02 * 0.8]]) * 15
    )  # δ as the light itself: nothing is wrong but the floor
    level = 0.03 * np.mean(even[0] ** 2 / chance[0])
    assert estimate.square_error(value, points, chance, even) >= level * (1 - 1e-12)


@pytest.mark.parametrize(("count", "drawn"), [(90, 45), (6, 8)])
def test_draws_go_by_the_light_by_its_root_at_the_edges_and_by_what_lies_near(
    count, drawn
):
    """A third each, of every depth for itself; eight points of a depth at least."""
    value = light(3, depths=2)[0]
    rng = np.random.default_rng(8)
    edges, near = rng.uniform(1, 10, value.shape[1]), rng.uniform(0, 1, value.shape[1])
    points, chance = estimate.draw_pixels(
        value, estimate.morton_scan(SHAPE), count, edges, near
    )
    assert points.shape == (2, drawn)
    for row, at, told in zip(value, points, chance, strict=True):
        root = np.sqrt(row) * edges
        density = (row + root / root.sum() + near / near.sum()) / 3
        assert told == pytest.approx(density[at], rel=1e-12)
        assert (
            np.abs(np.bincount(at, minlength=len(row)) - drawn * density).max()
            < 1 + 1e-9
        )
    plain = estimate.draw_pixels(
        value, estimate.morton_scan(SHAPE), 2 * value.shape[1] - 2
    )[1]
    assert plain.shape == (2, value.shape[1] - 1)  # one less than all


def test_parts_of_a_window_lie_one_after_the_other_and_have_neighbours_of_their_own():
    """Means of 9 x 9 pixels, mirrored at the ends of each part."""
    shapes, rng = [(5, 12), (11, 3)], np.random.default_rng(9)
    mean = rng.uniform(0, 1, 60 + 33)
    want = []
    for part, (rows, columns) in zip((mean[:60], mean[60:]), shapes, strict=True):
        around = np.pad(part.reshape(rows, columns), 4, mode="symmetric")
        want += [
            around[i : i + 9, j : j + 9].mean()
            for i in range(rows)
            for j in range(columns)
        ]
    assert estimate._near(mean, shapes) == pytest.approx(np.array(want), rel=1e-12)
    order = estimate._orders([(3, 5, 12), (3, 11, 3)])
    assert order[:60].tolist() == estimate.morton_scan((5, 12)).tolist()
    assert order[60:].tolist() == (60 + estimate.morton_scan((11, 3))).tolist()
