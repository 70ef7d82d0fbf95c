"""Sheets, layers and weights of a scene in closed form: what hides what, and what two
depths share.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.image import Frames, scene
from metalens.image.scene import PsfBasis

RNG = np.random.default_rng(17)


def sheets(near, far):
    return torch.tensor([[[[near]], [[far]]]], dtype=torch.float64)


@pytest.mark.parametrize("mean", [0.0, 0.7])
def test_a_near_sheet_hides_what_it_covers_of_a_far_one(mean):
    """Light 0.2 through coverage 0.3 before 0.5 through 0.8, of which 0.7 is free: (0.2
    + 0.5 * 0.7 / 0.8) / 1, and
    the mean that was taken off all light comes back whole."""
    got = scene._over(sheets(0.2, 0.5), sheets(0.3, 0.8), mean)
    assert float(got) == pytest.approx(0.2 + 0.5 * 0.7 / 0.8 + mean, rel=1e-9)
    bright = scene._over(
        sheets(0.2, 0.5), sheets(0.9, 0.0), 0.0
    )  # no far sheet: the near one over what it covers
    assert float(bright) == pytest.approx(0.2 / 0.9, rel=1e-9)


def test_light_between_two_depths_is_shared_by_its_inverse_depth():
    """Sources at 12, 16 and 30 mm, nodes at 10, 20 and 40 mm; the last sheet is empty."""
    depths = torch.tensor([10e3, 20e3, 40e3], dtype=torch.float64)
    where = torch.tensor(
        [[[[12e3, 16e3, 30e3]], [[99e3, 99e3, 99e3]]]], dtype=torch.float64
    )
    light = torch.tensor([[[[2.0, 3.0, 5.0]], [[0.0, 0.0, 0.0]]]], dtype=torch.float64)
    cover = torch.tensor([[[[1.0, 0.5, 1.0]], [[0.0, 0.0, 0.0]]]], dtype=torch.float64)
    made = scene.cut(Frames(light, cover, where), depths)

    def share(z, a, b):
        return (1 / z - 1 / b) / (1 / a - 1 / b)

    s, t, u = share(12e3, 10e3, 20e3), share(16e3, 10e3, 20e3), share(30e3, 20e3, 40e3)
    want = [
        [2 * s, 3 * t, 0.0],
        [2 * (1 - s), 3 * (1 - t), 5 * u],
        [0.0, 0.0, 5 * (1 - u)],
    ]
    assert made.radiance[0, :, 0].numpy() == pytest.approx(np.array(want), abs=1e-12)
    covers = np.array(want) * np.array([1 / 2, 0.5 / 3, 1 / 5])
    assert made.coverage[0, :, 0].numpy() == pytest.approx(covers, abs=1e-12)
    assert made.depth_um.tolist() == [10e3, 20e3, 40e3]


def test_weights_over_the_field_are_bilinear_and_over_depth_straight_in_inverse_depth():
    """2 x 3 field points and two depths of one kernel; a frame of 3 x 5 pixels from
    corner to corner.
    """
    weights = torch.from_numpy(RNG.uniform(0.2, 1.0, (2, 3, 2, 1)))
    psf = PsfBasis(
        torch.ones(1, 3, 3),
        weights,
        torch.tensor([10e3, 30e3], dtype=torch.float64),
        0.0,
        0.0,
    )
    depth = torch.full((1, 3, 5), 14e3, dtype=torch.float64)
    got = scene.weight_maps(psf, depth)[0, 0].numpy()
    deep = (1 / 10e3 - 1 / 14e3) / (1 / 10e3 - 1 / 30e3)
    at = (1 - deep) * weights[..., 0, 0].numpy() + deep * weights[..., 1, 0].numpy()
    for i in range(3):
        for j in range(5):
            y, x = i / 2, j / 2
            a, b = min(int(y), 0), min(int(x), 1)
            u, v = y - a, x - b
            want = (1 - u) * ((1 - v) * at[a, b] + v * at[a, b + 1]) + u * (
                (1 - v) * at[a + 1, b] + v * at[a + 1, b + 1]
            )
            assert got[i, j] == pytest.approx(
                want, abs=3e-4
            )  # depths are coded in 4096 steps of their range


@pytest.mark.parametrize("field", [(3, 1), (1, 4), (4, 3)])
def test_weights_of_one_depth_go_straight_from_field_point_to_field_point(field):
    """Two kernels, a frame of 5 x 8 pixels from corner to corner: along one axis, then
    along the other.
    """
    weights = torch.from_numpy(RNG.uniform(0.2, 1.0, (*field, 1, 2)))
    psf = PsfBasis(
        torch.ones(2, 3, 3),
        weights,
        torch.tensor([21e3], dtype=torch.float64),
        0.0,
        0.0,
    )
    got = scene.weight_maps(psf, torch.full((1, 5, 8), 33e3, dtype=torch.float64))
    assert got.shape == (2, 1, 5, 8)
    down, across = (
        np.linspace(0, n - 1, pixels) for n, pixels in zip(field, (5, 8), strict=True)
    )
    for k in range(2):
        rows = np.array(
            [
                np.interp(across, np.arange(field[1]), row)
                for row in weights[:, :, 0, k].numpy()
            ]
        )
        want = np.array(
            [np.interp(down, np.arange(field[0]), column) for column in rows.T]
        ).T
        assert got[k, 0].numpy() == pytest.approx(want, rel=1e-12)


def test_weights_of_one_field_point_go_straight_in_inverse_depth_and_stay_beyond_the_nodes():
    weights = torch.from_numpy(RNG.uniform(0.2, 1.0, (1, 1, 3, 2)))
    nodes = torch.tensor([10e3, 17e3, 40e3], dtype=torch.float64)
    psf = PsfBasis(torch.ones(2, 3, 3), weights, nodes, 0.0, 0.0)
    depth = torch.tensor(
        [[[8e3, 10e3, 12e3, 16e3], [19e3, 33e3, 40e3, 70e3]]], dtype=torch.float64
    )
    got = scene.weight_maps(psf, depth)
    for k in range(2):
        want = np.interp(
            -1 / depth.numpy(), -1 / nodes.numpy(), weights[0, 0, :, k].numpy()
        )
        assert got[k].numpy() == pytest.approx(
            want, abs=3e-4
        )  # depths are coded in 4096 steps of their range


def test_a_depth_takes_the_nearest_of_4096_steps_of_inverse_depth():
    """A weight that goes from 0 to 1 tells the depth: by half a step at most, and half
    a step it is met.
    """
    nodes = torch.tensor([9e3, 45e3], dtype=torch.float64)
    psf = PsfBasis(
        torch.ones(1, 3, 3),
        torch.tensor([0.0, 1.0]).double().view(1, 1, 2, 1),
        nodes,
        0.0,
        0.0,
    )
    unit = torch.from_numpy(RNG.uniform(0, 1, (1, 40, 50)))
    depth = 1 / (1 / 9e3 + unit * (1 / 45e3 - 1 / 9e3))
    off = ((scene.weight_maps(psf, depth)[0] - unit) * 4095).numpy()
    assert np.abs(off).max() <= 0.5 + 1e-6
    assert (off.min(), off.max()) == pytest.approx(
        (-0.5, 0.5), abs=0.01
    )  # of 2000 depths


def test_border_pixels_go_on_half_to_either_side():
    row = torch.arange(4.0).reshape(1, 1, 4)
    got = scene.padded(row, (1, 9))[0, 0].tolist()
    assert got == [0, 1, 2, 3, 3, 3, 3, 0, 0]


def test_the_mean_of_frames_is_their_light_over_their_coverage():
    frames = SimpleNamespace(
        radiance=torch.tensor([1.0, 2.0, 3.0, 6.0]).reshape(1, 2, 1, 2),
        coverage=torch.tensor([1.0, 0.5, 0.0, 1.5]).reshape(1, 2, 1, 2),
    )
    assert float(scene._mean(frames)) == pytest.approx(4.0)


def by_loops(source, kernel):
    """(y, x) sum of shifted pictures, the kernel's middle at (h // 2, w // 2); zeros
    outside.
    """
    (h, w), (high, wide) = kernel.shape, source.shape
    padded = np.pad(source, ((h, h), (w, w)))
    out = np.zeros(source.shape)
    for i, j in np.ndindex(h, w):
        y, x = h - (i - h // 2), w - (j - w // 2)
        out += kernel[i, j] * padded[y : y + high, x : x + wide]
    return out


@pytest.mark.parametrize(
    ("field", "kind"),
    [
        ((1, 1), torch.float32),
        ((1, 1), torch.float64),
        ((2, 3), torch.float64),
        ((3, 1), torch.float64),
    ],
)
def test_an_image_is_the_near_sheet_over_the_far_one_each_blurred_by_its_depths(
    field, kind
):
    """Five frames of 12 by 17 pixels, two at a time, kernels of 5 by 3: inside a margin
    of two, by plain sums.
    """
    rng = np.random.default_rng(23)
    cover = rng.uniform(0.0, 1.0, (5, 1, 12, 17))
    cover[4] = 1.0  # nothing seen of the far sheet
    cover = np.concatenate([cover, 1 - cover], 1)
    light = cover * rng.uniform(0.2, 2.0, cover.shape)
    depth = rng.uniform(9e3, 50e3, cover.shape)
    kernels = rng.uniform(0.1, 1.0, (2, 5, 3))
    weights = rng.uniform(0.3, 1.0, (*field, 3, 2)) / 15
    nodes = torch.tensor([10e3, 18e3, 42e3], dtype=torch.float64)
    psf = PsfBasis(
        torch.tensor(kernels, dtype=kind),
        torch.tensor(weights, dtype=kind),
        nodes,
        0.0,
        0.0,
    )
    frames = Frames(*(torch.tensor(a, dtype=kind) for a in (light, cover, depth)))
    optics = scene.uniform_imager(psf, (12, 17), margin=2)
    got = scene.image(frames, optics, margin=2).double().numpy()
    assert got.shape == (5, 8, 13)
    maps = (
        scene.weight_maps(psf, frames.depth_um).double().numpy()
    )  # (rank, frames, sheets, y, x)
    for n in range(5):
        seen = np.zeros((2, 2, 12, 17))
        for kind_of, picture in enumerate((light, cover)):
            for sheet in (0, 1):
                for r in range(2):
                    seen[kind_of, sheet] += by_loops(
                        maps[r, n, sheet] * picture[n, sheet], kernels[r]
                    )
        (near, far), (front, back) = seen
        share = np.clip(back / scene.FAINT, 0, 1)
        behind = (
            np.clip(1 - front, 0, 1)
            * share
            * (3 - 2 * share)
            / np.maximum(back, scene.FAINT)
        )
        want = (near + behind * far) / np.maximum(front + behind * back, scene.FAINT)
        assert got[n] == pytest.approx(
            want[2:-2, 2:-2], rel=1e-4 if kind is torch.float32 else 1e-9
        )
    wide = scene.uniform_imager(psf, (12, 17))
    assert all(
        have >= need for have, need in zip(wide.shape, (12 + 4, 17 + 4), strict=True)
    )  # two to either side
    plain = scene.image(frames, wide).double()
    kept = scene.image_spectra(scene.spectra(frames, wide), wide, (12, 17)).double()
    assert kept.numpy() == pytest.approx(
        plain.numpy(), rel=1e-3 if kind is torch.float32 else 1e-9
    )
    assert plain[:, 2:-2, 2:-2].numpy() == pytest.approx(
        got, rel=1e-4 if kind is torch.float32 else 1e-9
    )


def test_a_far_sheet_fades_in_smoothly():
    """Of a coverage of 0.004 of 0.01: 0.4² (3 - 0.8) = 0.352 of the weight that it
    would have.
    """
    got = scene._over(sheets(0.2, 0.003), sheets(0.3, 0.004), 0.0)
    behind = 0.7 * 0.352 / 0.004
    assert float(got) == pytest.approx(
        (0.2 + behind * 0.003) / (0.3 + behind * 0.004), rel=1e-9
    )
