"""Information measures against closed forms, and the honest axial information against
the cheat it prevents.
"""

import math

import numpy as np
import pytest
import torch

from metalens import fisher
from metalens.core.errors import SceneError
from metalens.image import pupil as pupils
from metalens.image.pupil import Pupil
from metalens.psf import whole_pixels

torch.manual_seed(0)
J = torch.randn(2, 30, 40, dtype=torch.float64)


def test_matrix_is_the_inner_product_of_sensitivities():
    f = fisher.information(J)
    assert float(f[0, 1]) == pytest.approx(float((J[0] * J[1]).sum()), rel=1e-12)
    v = torch.rand(30, 40, dtype=torch.float64) + 0.5
    assert float(fisher.information(J, v)[1, 1]) == pytest.approx(
        float((J[1] ** 2 / v).sum()), rel=1e-12
    )


def test_loss_floor_acts_reports_and_keeps_a_finite_gradient():
    dark = torch.zeros(2, 5, 5, dtype=torch.float64, requires_grad=True)
    loss = fisher.optics_loss(fisher.information(dark), torch.tensor(0.7))
    loss.value.backward()
    assert loss.floored == (0, 1)
    assert torch.isfinite(dark.grad).all()
    bright = fisher.optics_loss(fisher.information(J), torch.tensor(0.7))
    assert bright.floored == ()


def test_loss_is_equation_6():
    f = torch.tensor([[4.0, 1.0], [1.0, 9.0]], dtype=torch.float64)
    loss = fisher.optics_loss(
        f, torch.tensor(0.8), orthogonality=0.5, compactness=2.0, relative=False
    )
    assert float(loss.value) == pytest.approx(
        -math.log(36) + 0.5 * 2 + 2 * 0.2, rel=1e-6
    )
    assert torch.autograd.gradcheck(
        lambda j: fisher.optics_loss(fisher.information(j), torch.tensor(0.5)).value,
        J[:, :3, :3].clone().requires_grad_(True),
    )


def test_floor_has_a_continuous_value_and_slope():
    def at(level):
        f = torch.diag(torch.tensor([level, 1.0], dtype=torch.float64)).requires_grad_(
            True
        )
        loss = fisher.optics_loss(f, torch.tensor(1.0), floor=1e-3)
        loss.value.backward()
        return float(loss.value.detach()), float(f.grad[0, 0])

    (below, slope_below), (above, slope_above) = at(1e-3 - 1e-12), at(1e-3 + 1e-12)
    assert below == pytest.approx(above, abs=1e-8)
    assert slope_below == pytest.approx(slope_above, rel=1e-6)


def test_bounds_match_the_scatter_of_the_best_estimate():
    rng = np.random.default_rng(3)
    bound = fisher.cramer_rao(
        fisher.information(J, torch.full((30, 40), 0.25, dtype=torch.float64))
    ).numpy()
    a = J.reshape(2, -1).numpy().T
    estimates = np.linalg.lstsq(
        a, 0.5 * rng.standard_normal((a.shape[0], 4000)), rcond=None
    )[0]
    # 4000 draws: 1.1 % of standard error
    assert estimates.std(1) == pytest.approx(bound, rel=0.05)


def test_axial_information_of_a_moving_spot_is_known():
    """A Gaussian of width w that moves by v dz has I = v² / 2 w² in L2 normalisation,
    on pixels much finer than w.
    """
    s = (torch.arange(240, dtype=torch.float64) - 119.5) * 0.5
    near = torch.exp(-(s[:, None] ** 2 + s**2) / (2 * 12**2))
    far = torch.exp(-(s[:, None] ** 2 + (s - 0.2) ** 2) / (2 * 12**2))
    value = fisher.axial_information(
        near, far, step_um=200.0, sample_um=0.5, pixel_um=1.5
    )
    # pixel box widens w² by p²/12: 0.1 %
    assert float(value) == pytest.approx(1.0**2 / (2 * 12**2), rel=0.01)
    by_sum = fisher.axial_information(
        near, far, step_um=200.0, sample_um=0.5, pixel_um=1.5, normalisation="sum"
    )
    # sum of squares over square of sum, of a Gaussian
    ratio = 1.5**2 / (4 * math.pi * 12**2)
    assert float(by_sum / value) == pytest.approx(ratio, rel=0.02)


PUPIL = Pupil(nodes=128)
DEPTHS = torch.arange(16e3, 26.01e3, 2e3, dtype=torch.float64)


def _stacks(phase, sample_um, samples, depths=DEPTHS):
    setting = dict(focus_um=20e3, sample_um=sample_um, samples=samples)
    near = pupils.psf(phase, PUPIL, depths_um=depths, **setting)
    return near, pupils.psf(phase, PUPIL, depths_um=depths + 200, **setting)


def test_coarse_samples_are_refused_where_honesty_is_promised():
    near, far = _stacks(torch.zeros(128, 128, dtype=torch.float64), 1.5, 96)
    with pytest.raises(SceneError, match="sampled"):
        fisher.axial_information(near, far, step_um=200.0, sample_um=1.5, pixel_um=3.0)


def test_hyperbolic_lens_has_the_known_honest_information():
    flat = torch.zeros(128, 128, dtype=torch.float64)
    near, far = _stacks(
        flat, 0.75, 192, torch.arange(16e3, 26.01e3, 1e3, dtype=torch.float64)
    )
    honest = [
        float(
            fisher.axial_information(
                near, far, step_um=200.0, sample_um=0.75, pixel_um=3.0 * b
            ).mean()
        )
        for b in (1, 2, 3)
    ]
    # measured apart, in a paraxial model
    assert honest == pytest.approx([0.24, 0.09, 0.045], rel=0.06)


def test_texture_information_ignores_where_the_light_lands():
    s = torch.arange(64.0) - 32
    widths = torch.tensor([2.0, 2.1, 2.2])
    blur = torch.exp(-(s[:, None] ** 2 + s**2) / (2 * widths[:, None, None] ** 2))
    blur = blur / blur.sum((1, 2), keepdim=True)
    drift = torch.stack([torch.roll(b, (3 * i, i), (0, 1)) for i, b in enumerate(blur)])
    setting = dict(step_um=500.0, spectrum=torch.ones(64, 33), noise=1e-4)
    assert torch.allclose(
        fisher.texture_information(blur, **setting),
        fisher.texture_information(drift, **setting),
        rtol=1e-4,
    )
    fixed = torch.stack([torch.roll(blur[0], (3 * i, i), (0, 1)) for i in range(3)])
    assert float(fisher.texture_information(fixed, **setting).max()) < 1e-3


@pytest.mark.parametrize(
    ("samples", "sample_um", "pitch_um"),
    [(48, 0.3, 0.9), (21, 0.7, 2.1), (50, 0.3, 1.7), (7, 0.9, 6.4)],
)
def test_pixels_inside_a_window_are_counted_as_by_hand(samples, sample_um, pitch_um):
    """Lengths are round numbers of 0.1 um: integers say how many pixels fit."""
    fit = samples * round(10 * sample_um) // round(10 * pitch_um)
    assert whole_pixels(samples, sample_um, pitch_um) == fit


def test_relative_orthogonality_of_unlike_informations():
    """F12² / (F11 F22), twice: 2 · 2.25 / 12; and the sum of the logarithms."""
    f = torch.tensor([[3.0, 1.5], [1.5, 4.0]], dtype=torch.float64)
    loss = fisher.optics_loss(
        f,
        torch.tensor([0.2, 0.7], dtype=torch.float64),
        orthogonality=0.7,
        compactness=1.9,
    )
    parts = (-math.log(12), 0.7 * 2 * 2.25 / 12, 1.9 * 0.55)
    assert [
        float(v) for v in (loss.sensitivity, loss.orthogonality, loss.compactness)
    ] == pytest.approx(parts)
    assert float(loss.value) == pytest.approx(sum(parts))


def test_bounds_of_unlike_correlated_parameters_are_those_of_the_inverse():
    f = torch.tensor(
        [[9.0, 2.0, 0.5], [2.0, 4e4, -80.0], [0.5, -80.0, 1.7]], dtype=torch.float64
    )
    want = np.sqrt(np.diag(np.linalg.inv(f.numpy())))
    assert fisher.cramer_rao(f).numpy() == pytest.approx(want, rel=1e-10)
    pair = torch.stack([J[0], 3 * J[0], J[1]])
    assert torch.isinf(fisher.cramer_rao(fisher.information(pair))).tolist() == [
        True,
        True,
        False,
    ]


def test_encircled_energy_on_a_window_with_unlike_sides():
    """A bright sample at (row 4, column 9) of 11 x 15, 2.24 samples from the middle:
    half in at its distance.
    """
    spot = torch.zeros(11, 15, dtype=torch.float64)
    spot[4, 9] = 0.7
    distance = math.hypot(-1, 2) * 0.4
    for off, share in ((-0.3, 0.0), (-0.1, 0.25), (0.0, 0.5), (0.1, 0.75), (0.3, 1.0)):
        found = fisher.encircled_energy(spot, 0.4, radius_um=distance + off)
        assert float(found) == pytest.approx(0.7 * share, abs=1e-12)


def test_texture_information_is_that_of_differences_of_the_power():
    """Half the squared slope of ln S over every frequency of the plane, also for an odd
    number of columns.
    """
    generator = torch.Generator().manual_seed(4)
    for columns in (6, 7):
        psf = torch.rand(3, 5, columns, generator=generator, dtype=torch.float64)
        half = (
            torch.rand(5, columns // 2 + 1, generator=generator, dtype=torch.float64)
            + 0.5
        )
        # a real texture: S(f) = S(-f)
        half[:, 0] = (half[:, 0] + half[:, 0].roll(1).flip(0)) / 2
        if columns % 2 == 0:
            half[:, -1] = (half[:, -1] + half[:, -1].roll(1).flip(0)) / 2
        found = fisher.texture_information(psf, step_um=170.0, spectrum=half, noise=0.3)
        whole = torch.zeros(5, columns, dtype=torch.float64)
        whole[:, : columns // 2 + 1] = half
        for i in range(5):
            for j in range(columns // 2 + 1, columns):
                whole[i, j] = half[-i % 5, columns - j]
        logs = torch.log(torch.fft.fft2(psf).abs() ** 2 * whole + 0.3)
        want = 0.5 * (((logs[1:] - logs[:-1]) / 0.17) ** 2).sum((1, 2))
        assert torch.allclose(found, want, rtol=1e-10)
