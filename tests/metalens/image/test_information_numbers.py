"""Fisher information and what follows from it, by small matrices and images that are
typed in.
"""

import math

import numpy as np
import pytest
import torch

from metalens.core.errors import SceneError
from metalens.image import information as fisher

RNG = np.random.default_rng(12)


def tensor(values):
    return torch.tensor(np.asarray(values, float))


def test_information_weighs_products_by_the_noise_of_each_pixel():
    slopes, variance = RNG.normal(size=(3, 4, 5)), RNG.uniform(0.5, 3, (4, 5))
    want = np.einsum("iyx,jyx,yx->ij", slopes, slopes, 1 / variance)
    assert fisher.information(
        tensor(slopes), tensor(variance)
    ).numpy() == pytest.approx(want, rel=1e-12)
    assert fisher.information(tensor(slopes)).numpy() == pytest.approx(
        np.einsum("iyx,jyx->ij", slopes, slopes)
    )


@pytest.mark.parametrize("degrees", [0.01, 25.0, 90.0, 140.0, 179.99])
def test_an_angle_of_fields_of_unlike_length(degrees):
    one, other = (
        np.array([3.0, 0.0]),
        0.2
        * np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))]),
    )
    found = fisher.span_angle(fisher.information(tensor([one, other])))
    assert math.degrees(found) == pytest.approx(
        degrees, abs=1e-4
    )  # 1e-16 of cos² under the root
    for dark in ([[0.0, 0.0], [0.0, 4.0]], [[4.0, 0.0], [0.0, 0.0]]):
        assert fisher.span_angle(tensor(dark)) == 0.0


F = np.array([[9.0, 2.0, -1.0], [2.0, 4.0, 0.5], [-1.0, 0.5, 0.25]])


@pytest.mark.parametrize("relative", [True, False])
def test_the_loss_of_an_optic_is_the_sum_of_its_three_parts(relative):
    found = fisher.optics_loss(
        tensor(F),
        tensor([0.6, 0.7]),
        orthogonality=3.0,
        compactness=5.0,
        relative=relative,
    )
    pairs = [(0, 1), (0, 2), (1, 2)]
    off = 2 * sum(
        F[i, j] ** 2 / (F[i, i] * F[j, j] if relative else 1) for i, j in pairs
    )
    parts = -math.log(9 * 4 * 0.25), 3 * off, 5 * 0.35
    assert [
        float(p) for p in (found.sensitivity, found.orthogonality, found.compactness)
    ] == pytest.approx(parts)
    assert float(found.value) == pytest.approx(sum(parts))
    assert found.floored == ()


def test_below_the_floor_the_logarithm_goes_on_as_its_tangent():
    """ln c + (F - c) / c, of slope 1 / c; the floor stands in the product of relative
    terms.
    """
    weak = tensor(F).requires_grad_()
    found = fisher.optics_loss(weak, tensor(1.0), floor=0.5)
    assert found.floored == (2,)
    assert found.sensitivity.item() == pytest.approx(
        -math.log(36) - math.log(0.5) - (0.25 - 0.5) / 0.5
    )
    want = 2 * (4 / 36 + 1 / (9 * 0.5) + 0.25 / (4 * 0.5))
    assert found.orthogonality.item() == pytest.approx(want)
    found.sensitivity.backward()
    assert torch.diagonal(weak.grad).tolist() == pytest.approx(
        [-1 / 9, -1 / 4, -1 / 0.5]
    )


def test_encircled_light_counts_cut_samples_in_part():
    """5 x 4 samples of 0.5 um about (2, 1.5): within r those nearer than r / 0.5 - 1/2
    whole, one further none.
    """
    light = RNG.uniform(1, 2, (2, 5, 4))
    y, x = np.mgrid[:5, :4]
    away = np.hypot(y - 2, x - 1.5)
    for radius in (0.3, 0.8, 1.1):
        share = np.clip(radius / 0.5 + 0.5 - away, 0, 1)
        found = fisher.encircled_energy(tensor(light), 0.5, radius_um=radius)
        assert found.numpy() == pytest.approx((light * share).sum((1, 2)))


@pytest.mark.parametrize("normalisation", ["sum", "l2", "none"])
def test_axial_information_over_pixels_of_three_samples(normalisation):
    """Pixels of 3 x 3 samples on a window of 9 x 12: at no shift sums of blocks; steps
    of 40 um are 0.04 mm.
    """
    near, far = RNG.uniform(1, 9, (2, 9, 12))
    about = {
        "step_um": 40.0,
        "sample_um": 0.5,
        "pixel_um": 1.5,
        "normalisation": normalisation,
    }
    blocks = [image.reshape(3, 3, 4, 3).sum((1, 3)) for image in (near, far)]
    size = {"sum": np.sum, "l2": np.linalg.norm, "none": lambda pixels: 1.0}[
        normalisation
    ]
    a, b = (block / size(block) for block in blocks)
    found = float(fisher.pixel_information(tensor(near), tensor(far), **about))
    assert found == pytest.approx(((b - a) ** 2).sum() / 0.04**2, rel=1e-9)
    shifts = [-0.5, 0.0, 0.5]
    pixels = [
        float(
            fisher.pixel_information(
                tensor(near), tensor(far), **about, shift_um=(y, x)
            )
        )
        for y in shifts
        for x in shifts
    ]
    mean = float(fisher.axial_information(tensor(near), tensor(far), **about))
    assert mean == pytest.approx(np.mean(pixels), rel=1e-9)
    assert len(set(pixels)) == 9
    two = float(
        fisher.axial_information(tensor(near), tensor(far), **about, positions=2)
    )
    quarters = [
        float(
            fisher.pixel_information(
                tensor(near), tensor(far), **about, shift_um=(y, x)
            )
        )
        for y in (-0.375, 0.375)
        for x in (-0.375, 0.375)
    ]
    assert two == pytest.approx(np.mean(quarters), rel=1e-9)
    with pytest.raises(SceneError, match="need at most"):
        fisher.axial_information(
            tensor(near), tensor(far), **(about | {"sample_um": 0.51})
        )
    with pytest.raises(SceneError, match="positions = 0"):
        fisher.axial_information(tensor(near), tensor(far), **about, positions=0)


@pytest.mark.parametrize("width", [6, 7])
def test_a_texture_tells_depth_by_all_frequencies_of_both_signs(width):
    """Half of Σ (d log S / dz)² over the whole plane of frequencies, not only those
    that a real transform keeps.
    """
    psf, noise = RNG.uniform(0, 1, (3, 5, width)), 0.7
    fy, fx = np.fft.fftfreq(5)[:, None], np.fft.fftfreq(width)
    spectrum = 3 / (0.01 + fy**2 + 2 * fx**2)
    power = np.log(np.abs(np.fft.fft2(psf)) ** 2 * spectrum + noise)
    want = 0.5 * (np.diff(power, axis=0) ** 2).sum((1, 2)) / 0.025**2
    half = tensor(spectrum[:, : width // 2 + 1])
    found = fisher.texture_information(
        tensor(psf), step_um=25.0, spectrum=half, noise=noise
    )
    assert found.numpy() == pytest.approx(want, rel=1e-9)


def test_what_is_left_beside_nuisances_is_the_inverse_of_a_part_of_the_inverse():
    mixed = RNG.normal(size=(4, 9)) * np.array([1.0, 30.0, 0.02, 5.0])[:, None]
    whole = mixed @ mixed.T
    for wanted in (1, 2, 3):
        want = np.linalg.inv(np.linalg.inv(whole)[:wanted, :wanted])
        assert fisher.without_nuisance(tensor(whole), wanted).numpy() == pytest.approx(
            want, rel=1e-8
        )
    unseen = np.zeros((3, 3))
    unseen[:2, :2] = [[5.0, 2.0], [2.0, 4.0]]
    assert fisher.without_nuisance(tensor(unseen), 1).item() == pytest.approx(5 - 4 / 4)


def test_the_least_standard_deviation_is_the_root_of_the_inverse():
    mixed = RNG.normal(size=(4, 9)) * np.array([1.0, 30.0, 0.02, 5.0])[:, None]
    whole = mixed @ mixed.T
    want = np.sqrt(np.diag(np.linalg.inv(whole)))
    assert fisher.cramer_rao(tensor(whole)).numpy() == pytest.approx(want, rel=1e-8)
    blind = np.array(
        [[4.0, 6.0, 0.0], [6.0, 9.0, 0.0], [0.0, 0.0, 0.04]]
    )  # the first two are one
    assert fisher.cramer_rao(tensor(blind)).tolist() == pytest.approx(
        [math.inf, math.inf, 5.0]
    )
    dark = np.diag([4.0, 0.0])
    assert fisher.cramer_rao(tensor(dark)).tolist() == pytest.approx([0.5, math.inf])
