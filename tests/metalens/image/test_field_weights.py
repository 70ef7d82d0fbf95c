"""Weights of kernels over the field, by hand; rim cells of an oblique pupil against
points counted inside them.
"""

import numpy as np
import pytest
import torch

from metalens.image import pupil as pupils
from metalens.image import scene
from metalens.image.pupil import Field, Pupil
from metalens.image.scene import Frames, PsfBasis

RNG = np.random.default_rng(31)


def made(rows, columns, depths, rank=3, kernels=None):
    """Unlike weights at every field point and depth."""
    weights = torch.from_numpy(
        RNG.uniform(0.2, 1.7, (rows, columns, len(depths), rank))
    )
    kernels = (
        torch.from_numpy(RNG.uniform(0, 1, (rank, 3, 5)))
        if kernels is None
        else kernels
    )
    return PsfBasis(
        kernels, weights, torch.tensor(depths, dtype=torch.float64), 0.0, 0.0
    )


@pytest.mark.parametrize(("rows", "columns"), [(3, 2), (2, 4), (1, 3), (4, 1)])
def test_weights_are_bilinear_between_field_points_from_corner_to_corner(rows, columns):
    """At the depths of the nodes, so that only the field interpolates."""
    psf = made(rows, columns, [18e3, 31e3])
    far = torch.from_numpy(RNG.uniform(size=(7, 9)) > 0.5)
    maps = scene.weight_maps(psf, torch.where(far, 31e3, 18e3).double()).numpy()
    table, down, across = (
        psf.weights.numpy(),
        np.linspace(0, rows - 1, 7),
        np.linspace(0, columns - 1, 9),
    )
    for i, j in np.ndindex(7, 9):
        tent = [
            np.maximum(1 - abs(p - np.arange(n)), 0)
            for p, n in ((down[i], rows), (across[j], columns))
        ]
        want = np.einsum("r,c,rck->k", *tent, table[:, :, int(far[i, j])])
        assert maps[:, i, j] == pytest.approx(want, rel=1e-9)


def test_one_depth_has_one_weight_wherever_the_source_lies():
    psf = made(2, 3, [20e3])
    maps = scene.weight_maps(
        psf, torch.tensor([[5e3, 2e4, 9e4], [2e4, 1e4, 8e4]], dtype=torch.float64)
    ).numpy()
    for i, j in np.ndindex(2, 3):
        assert maps[:, i, j] == pytest.approx(psf.weights[i, j, 0].numpy(), rel=1e-12)


def test_an_image_with_kernels_that_vary_over_the_field_is_the_sum_over_its_sources():
    """One sheet that covers all: radiance times weights, convolved; the border pixel
    goes on for ever.
    """
    height, width = 11, 13
    psf = made(3, 2, [18e3, 31e3], rank=2)
    psf = PsfBasis(
        psf.kernels / psf.kernels.sum((1, 2), keepdim=True),
        psf.weights,
        psf.depths_um,
        0.0,
        0.0,
    )
    light = torch.zeros(1, 2, height, width, dtype=torch.float64)
    light[0, 0] = torch.from_numpy(RNG.uniform(0.5, 2.0, (height, width)))
    cover = torch.zeros_like(light)
    cover[:, 0] = 1.0
    depth = torch.full_like(light, 31e3)
    got = scene.image(
        Frames(light, cover, depth), scene.uniform_imager(psf, (height, width))
    )[0].numpy()
    maps = scene.weight_maps(psf, depth[0, 0]).numpy()
    total = [
        np.zeros((height, width)),
        np.zeros((height, width)),
    ]  # of light, of coverage
    for part, source in zip(
        total, (light[0, 0].numpy(), np.ones((height, width))), strict=True
    ):
        for weight, kernel in zip(maps, psf.kernels.numpy(), strict=True):
            spread = np.pad(source * weight, ((2, 2), (3, 3)), mode="edge")
            for (i, j), share in np.ndenumerate(
                kernel
            ):  # the middle of the kernel is at [1, 2]
                part += share * spread[3 - i : 3 - i + height, 5 - j : 5 - j + width]
    assert got == pytest.approx(total[0] / total[1], rel=1e-6)


@pytest.mark.parametrize("field", [Field(0.0), Field(0.21, 0.7), Field(0.33, -2.0)])
def test_rim_cells_weigh_what_lies_inside_the_aperture(field):
    """Weight times 1 - q² is the share of a cell inside: of 24² rays through it, those
    that meet the lens.
    """
    pupil = Pupil(nodes=64)
    seen = pupils.view(pupil, field, 20e3)
    d, (cx, cy) = (
        pupil.sensor_distance_um,
        (pupil.sensor_distance_um * t for t in field.tangents),
    )
    x, y = seen.x_um.numpy() - cx, seen.y_um.numpy() - cy
    path = np.sqrt(x**2 + y**2 + d**2)
    cell = 2 * pupil.edge / pupil.nodes
    part = (np.arange(24) + 0.5) / 24 - 0.5
    qx = (x / path)[..., None, None] + part * cell
    qy = (y / path)[..., None, None] + part[:, None] * cell
    rest = np.sqrt(np.maximum(1 - qx**2 - qy**2, 1e-3))
    inside = np.hypot(cx + qx * d / rest, cy + qy * d / rest) < pupil.radius_um
    share = inside.mean((-2, -1))
    found = seen.weight.numpy() * (d / path) ** 2
    assert found[share == 1].min() > 0.9  # a diagonal cell's corner
    assert found[share == 0].max() < 0.1
    rim = (share > 0) & (share < 1)
    assert np.abs(found - share)[rim].mean() < 0.03  # the rim's slant within a cell
    assert found.sum() == pytest.approx(share.sum(), rel=1e-3)


@pytest.mark.parametrize("field", [Field(0.21, 0.7), Field(0.33, -2.0)])
def test_rays_of_a_field_take_the_phase_of_the_node_nearest_to_them(field):
    """Places of the on-axis nodes, in cosines from the axis: none lies nearer to where
    a ray leaves the lens.
    """
    pupil = Pupil(nodes=64)
    seen = pupils.view(pupil, field, 20e3)
    nodes = pupils.axis(pupil).numpy()
    path = np.sqrt(
        seen.x_um.numpy() ** 2 + seen.y_um.numpy() ** 2 + pupil.sensor_distance_um**2
    )
    lit = seen.weight.numpy() > 0
    row, column = (n[lit] for n in divmod(seen.node.numpy(), 64))
    for got, place in ((row, seen.y_um.numpy()), (column, seen.x_um.numpy())):
        assert np.array_equal(
            got, np.abs(nodes - (place / path)[lit][:, None]).argmin(1)
        )
    first, last = (np.argwhere(lit).min(0), 63 - np.argwhere(lit).max(0))
    assert (
        np.abs(first - last).max() <= 1
    )  # the aperture stands in the middle of the cosines
