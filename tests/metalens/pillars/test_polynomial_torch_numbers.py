"""Polynomials of the diameter on tensors: value, slope and both derivatives of each,
against powers by hand.
"""

import numpy as np
import pytest
import torch

from metalens.pillars import polynomial, polynomial_torch

COEFFICIENTS = np.array([0.7, -1.1, 0.4, 0.15])
ENDS = (0.1, 0.4)
D = np.array([0.13, 0.22, 0.37])


def by_hand(power):
    """The polynomial of the diameter and its derivatives, as plain powers of D."""
    low, high = ENDS[0] ** power, ENDS[1] ** power
    inner = np.polynomial.Polynomial(
        [-(high + low) / (high - low), *[0] * (power - 1), 2 / (high - low)]
    )
    whole = np.polynomial.Chebyshev(COEFFICIENTS).convert(
        kind=np.polynomial.Polynomial
    )(inner)
    return whole, whole.deriv(), whole.deriv(2)


@pytest.fixture(params=[1, 2, 3])
def known(request):
    return polynomial.curve(COEFFICIENTS, ENDS, request.param, np.inf), by_hand(
        request.param
    )


def tensor(**how):
    return torch.tensor(D, dtype=torch.float64, **how)


TIGHT = {"rel": 1e-11}  # of powers of 0.1 to 0.4 with their shifts, in float64


def test_values_and_slopes(known):
    curve, (value, slope, _) = known
    assert polynomial_torch.value(curve, tensor()).numpy() == pytest.approx(
        value(D), **TIGHT
    )
    assert polynomial_torch.slope(curve, tensor()).numpy() == pytest.approx(
        slope(D), **TIGHT
    )


@pytest.mark.parametrize("again", [False, True])
def test_derivatives_by_backward(known, again):
    """Each weighted by numbers of its own, with a graph for the next derivative and
    without.
    """
    curve, (_, slope, bend) = known
    weight = torch.tensor([2.0, -0.7, 1.3], dtype=torch.float64)
    for verb, want in ((polynomial_torch.value, slope), (polynomial_torch.slope, bend)):
        d = tensor(requires_grad=True)
        (found,) = torch.autograd.grad(verb(curve, d), d, weight, create_graph=again)
        assert found.detach().numpy() == pytest.approx(
            weight.numpy() * want(D), **TIGHT
        )
        assert found.requires_grad is again


def test_derivatives_forwards_and_over_a_batch(known):
    curve, (value, slope, bend) = known
    tangent = torch.tensor([2.0, -0.7, 1.3], dtype=torch.float64)
    for verb, forms in (
        (polynomial_torch.value, (value, slope)),
        (polynomial_torch.slope, (slope, bend)),
    ):
        out, moved = torch.func.jvp(
            lambda d, verb=verb: verb(curve, d), (tensor(),), (tangent,)
        )
        assert out.numpy() == pytest.approx(forms[0](D), **TIGHT)
        assert moved.numpy() == pytest.approx(tangent.numpy() * forms[1](D), **TIGHT)
        batch = torch.vmap(lambda d, verb=verb: verb(curve, d), 1)(
            tensor().reshape(1, 3)
        )
        assert batch.numpy() == pytest.approx(forms[0](D)[:, None], **TIGHT)


def test_torchs_own_operations_give_the_same_and_end_at_the_ceiling(known):
    """What another device runs, here on the processor."""
    curve, (value, slope, _) = known
    assert polynomial_torch._on_device(tensor(), curve, 0).numpy() == pytest.approx(
        value(D), **TIGHT
    )
    assert polynomial_torch._on_device(tensor(), curve, 1).numpy() == pytest.approx(
        slope(D), **TIGHT
    )
    low = polynomial.curve(COEFFICIENTS, ENDS, 1, 0.9)
    want = np.minimum(by_hand(1)[0](D), 0.9)
    assert (want == 0.9).any()
    assert (want < 0.9).any()
    for found in (
        polynomial_torch._on_device(tensor(), low, 0),
        polynomial_torch.value(low, tensor()),
    ):
        assert found.numpy() == pytest.approx(want, **TIGHT)


def test_a_single_precision_diameter_stays_one_and_a_wider_weight_is_taken(known):
    curve, (_, slope, _) = known
    d = torch.tensor(D, dtype=torch.float32, requires_grad=True)
    polynomial_torch.value(curve, d).backward(torch.ones(3))
    assert d.grad.dtype == torch.float32
    assert d.grad.numpy() == pytest.approx(
        slope(D), rel=1e-4
    )  # float32 beside a shift of 1
