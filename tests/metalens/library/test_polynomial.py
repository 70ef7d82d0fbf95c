"""Chunked polynomials against numpy's own, their slopes against the complex step, their
bounds against samples.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import chebyshev

from metalens.core.errors import DomainError
from metalens.library import polynomial

LOW, HIGH = 0.08, 0.21
COEFFICIENTS = np.array([3.0, 2.5, 0.8, -0.2, 0.05, 0.02, -0.01, 0.003, 0.001])


def reference(diameter, power):
    """The Chebyshev sum by numpy; also for complex diameters."""
    x = (2 * diameter**power - LOW**power - HIGH**power) / (HIGH**power - LOW**power)
    return sum(
        c * np.polynomial.chebyshev.chebval(x, np.eye(9)[k])
        for k, c in enumerate(COEFFICIENTS)
    )


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("shape", [(), (7, 5), (3, polynomial.CHUNK // 2)])
def test_value_and_slope(power, shape):
    d = np.random.default_rng(0).uniform(LOW, HIGH, shape)
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), power)
    assert (
        np.abs(polynomial.evaluate_curve(p, d) - reference(d, power)).max() < 1e-12
    )  # monomials up to 40: 40 eps
    step = np.imag(reference(d + 1e-30j, power)) / 1e-30
    assert (
        np.abs(polynomial.evaluate_slope(p, d) - step).max()
        < 1e-12 * np.abs(step).max()
    )  # monomials of the slope up to 300


def test_single_precision_stays_single():
    d = np.random.default_rng(1).uniform(LOW, HIGH, 1000)
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), 3)
    got = polynomial.evaluate_curve(p, d.astype(np.float32))
    assert got.dtype == np.float32
    assert (
        np.abs(got - reference(d, 3)).max() < 3e-5
    )  # 6e-8 of D times slope 100 rad/um, and of 6 rad


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=24), st.integers(1, 3))
def test_bounds_hold_everywhere_and_are_tight(terms, rows):
    c = np.resize(np.array(terms), (rows, max(1, len(terms) // rows)))
    x, y = np.linspace(-1, 1, 301), np.linspace(-1, 1, 41)
    sampled = chebyshev.chebgrid2d(y, x, c)
    low, high = polynomial.certified_bounds(c)
    assert low <= sampled.min() + 1e-12
    assert high >= sampled.max() - 1e-12
    span = np.abs(c).sum()
    assert (
        low >= sampled.min() - 0.02 * span
    )  # 301 samples of degree 23 miss up to (pi 23/301)²/8 of the range
    assert high <= sampled.max() + 0.02 * span


@pytest.mark.parametrize("bad", [0.0799, 0.2101, np.nan, np.inf, -1.0])
def test_outside_the_domain_is_refused(bad):
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), 2)
    for verb, values in (
        (polynomial.evaluate_curve, np.array([0.1, bad])),
        (polynomial.evaluate_slope, np.array([0.1, bad])),
        (polynomial.evaluate_curve, torch.tensor([0.1, bad], dtype=torch.float64)),
    ):
        with pytest.raises(DomainError, match=r"the proxy holds from 0\.08 to 0\.21"):
            verb(p, values)


def test_torch_derivatives_of_all_kinds():
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), 3)
    d = torch.linspace(0.09, 0.2, 6, dtype=torch.float64, requires_grad=True)

    def f(x):
        return polynomial.evaluate_curve(p, x)

    assert torch.autograd.gradcheck(f, d, check_forward_ad=True, eps=1e-7)
    assert torch.autograd.gradgradcheck(f, d, eps=1e-7)
    step = torch.from_numpy(np.imag(reference(d.detach().numpy() + 1e-30j, 3)) / 1e-30)
    for got in (
        torch.func.vmap(torch.func.grad(f))(d),
        torch.func.jvp(f, (d,), (torch.ones(6).double(),))[1],
    ):
        assert torch.allclose(got, step, rtol=1e-11)


def test_ceiling_takes_off_rounding_alone():
    p = polynomial.chebyshev_curve(np.array([1.0 + 1e-9]), (LOW, HIGH), 1, 1.0)
    assert polynomial.evaluate_curve(p, np.array([0.1])) == 1.0
    assert polynomial.evaluate_curve(p, torch.tensor([0.1])) == 1.0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_tensors_stay_on_their_device():
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), 3)
    host = torch.linspace(0.09, 0.2, 1000, dtype=torch.float64)
    d = host.cuda().requires_grad_()
    value = polynomial.evaluate_curve(p, d)
    value.sum().backward()
    assert value.is_cuda
    assert d.grad is not None
    assert torch.allclose(
        value.detach().cpu(), polynomial.evaluate_curve(p, host), rtol=1e-13
    )
    assert torch.allclose(d.grad.cpu(), polynomial.evaluate_slope(p, host), rtol=1e-12)
    with pytest.raises(DomainError):
        polynomial.evaluate_curve(p, 2 * d.detach())


@pytest.mark.parametrize("shape", [(5,), (200_000,), (3, 40)])
def test_the_backward_pass_is_the_slope_times_the_weight(shape):
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), 2)
    d = np.linspace(LOW, HIGH, math.prod(shape)).reshape(shape)
    weight = np.linspace(-1, 2, d.size).reshape(shape)
    leaf = torch.from_numpy(d).requires_grad_()
    value = polynomial.evaluate_curve(p, leaf)
    (once,) = torch.autograd.grad((torch.from_numpy(weight) * value).sum(), leaf)
    slope = np.imag(reference(d + 1e-30j, 2)) / 1e-30
    assert once.numpy() == pytest.approx(slope * weight, rel=1e-11, abs=1e-10)


@pytest.mark.parametrize("end", [0.8, 0.2, 0.02, 1e-6, 0.0])
def test_inverse_of_a_curve_that_is_nearly_flat_at_one_end(end):
    """Phase 4 u² + end u: between entries of the table the line is off by up to 1e-2 of
    u, and Newton must mend it;
    where the slope ends in 0, too, and the phase of that very end is its own."""
    p = polynomial.chebyshev_curve(np.array([6 + end, 8 + end, 2.0]), (LOW, HIGH), 1)
    u = np.concatenate(
        [[0.0] * (end == 0), np.geomspace(1e-9, 0.1, 2000), np.linspace(0.1, 1.2, 500)]
    )
    phase = 4 * u**2 + end * u
    # less than a turn of it, so that no phase is taken modulo 2 pi
    found = polynomial.invert_phase(
        p, phase[phase < 6], within_um=(LOW, LOW + 0.62 * (HIGH - LOW)), gap="nearest"
    )
    got = (found - LOW) * 2 / (HIGH - LOW)
    assert (
        np.abs(4 * got**2 + end * got - phase[phase < 6]).max() < 1e-10
    )  # as promised


def test_a_millionth_of_a_micrometre_beyond_the_domain_is_rounding():
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), 2)
    middle = (LOW + HIGH) / 2
    for end, beyond in ((LOW, -1e-6), (HIGH, 1e-6)):
        polynomial.check_domain(p, np.array([middle, end + 0.9 * beyond]))
        with pytest.raises(DomainError, match="keep the diameters inside"):
            polynomial.check_domain(p, np.array([middle, end + 1.1 * beyond]))
