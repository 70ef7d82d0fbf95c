"""The proxy record: what it returns, what it refuses, and its inverse."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from metalens.core.errors import DomainError
from metalens.library.proxy import Proxy
from tests.proxies import proxy_of

TURN = 2 * math.pi


def proxy(cover_turns: float = 1.2, power: int = 2) -> Proxy:
    """Phase rising with the area of the pillar, with a bend and a chromatic term."""
    half = cover_turns * math.pi
    phase = np.array([[half + 1, half, 0.1 * half, 0.02], [0.2, 0.1, 0.0, 0.0]])
    level = np.array([[0.9, 0.04, -0.03, 0.01], [0.01, 0.0, 0.0, 0.0]])
    return Proxy(phase, level, (0.08, 0.21), (0.84, 0.86), 1e-3, 2e-3, power)


D = np.linspace(0.08, 0.21, 400)


def test_values_are_the_chebyshev_sums():
    x = (2 * D**2 - 0.08**2 - 0.21**2) / (0.21**2 - 0.08**2)
    half = 1.2 * math.pi
    want = half + 1 + half * x + 0.1 * half * (2 * x**2 - 1) + 0.02 * (4 * x**3 - 3 * x)
    assert abs(proxy().phase_rad(D, 0.85) - want).max() < 1e-12
    assert abs(proxy().phase_rad(D, 0.86) - want - 0.2 - 0.1 * x).max() < 1e-12


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_leave_as_they_came(dtype):
    d = D.reshape(20, 20).astype(dtype)
    for got in (
        proxy().phase_rad(d, 0.85),
        proxy().transmission(d, 0.85),
        proxy().dphase_ddiameter(d, 0.85),
    ):
        assert isinstance(got, np.ndarray)
        assert (got.dtype, got.shape) == (dtype, (20, 20))
    t = torch.from_numpy(d)
    for got in (
        proxy().phase_rad(t, 0.85),
        proxy().transmission(t, 0.85),
        proxy().diameter_um(t, 0.85),
    ):
        assert isinstance(got, torch.Tensor)
        assert (got.dtype, got.shape) == (t.dtype, (20, 20))
    assert isinstance(proxy().phase_rad(0.1, 0.85), float)
    assert proxy().phase_rad(np.empty((0, 3)), 0.85).shape == (0, 3)


def test_gradients_in_torch_are_the_slopes():
    p = proxy()
    for verb, slope in (
        ("phase_rad", "dphase_ddiameter"),
        ("transmission", "dtransmission_ddiameter"),
    ):
        d = torch.from_numpy(D).requires_grad_()
        getattr(p, verb)(d, 0.853).sum().backward()
        assert d.grad is not None
        assert abs(d.grad.numpy() - getattr(p, slope)(D, 0.853)).max() < 1e-12
        h = 1e-6
        inner = D[1:-1]
        difference = (
            getattr(p, verb)(inner + h, 0.853) - getattr(p, verb)(inner - h, 0.853)
        ) / (2 * h)
        # rounding 1e-15 / h
        assert abs(difference - getattr(p, slope)(inner, 0.853)).max() < 1e-6


@settings(max_examples=60)
@given(
    st.lists(st.floats(-1, 1), min_size=1, max_size=14),
    st.lists(st.floats(-1, 1), min_size=14, max_size=14),
    st.sampled_from([np.float32, np.float64]),
)
def test_a_proxy_that_exists_never_exceeds_one(terms, tilt, dtype):
    level = np.array([terms, tilt[: len(terms)]])
    try:
        p = Proxy(level, level, (0.08, 0.21), (0.84, 0.86), 0.0, 0.0)
    except DomainError:
        return
    for wavelength in (0.84, 0.8471, 0.86):
        t = p.transmission(D.astype(dtype), wavelength)
        assert t.max() <= 1
        assert t.min() >= -1e-2  # the certificate is 1e-3 of the range wide


@pytest.mark.parametrize("level", [[1.2], [0.5, 0.51], [-0.1], [np.nan]])
def test_levels_outside_zero_to_one_are_refused(level):
    with pytest.raises(DomainError, match="need 0 to 1"):
        Proxy(np.array([[0.0]]), np.array([level]), (0.08, 0.2), (0.85, 0.85), 0.0, 0.0)


def test_places_where_the_error_is_not_known_are_refused():
    p = proxy()
    for call in (
        lambda: p.phase_rad(np.array([0.07]), 0.85),
        lambda: p.transmission(torch.tensor([0.22]), 0.85),
        lambda: p.phase_rad(D, 0.9),
        lambda: p.phase_rad(D, math.nan),
        lambda: p.phase_rad(D, 0.85, 0.1),
    ):
        with pytest.raises(DomainError, match="the proxy holds"):
            call()


def test_angle_enters_as_the_square_of_its_sine():
    base = proxy()
    phase = np.stack([base.phase_coefficients, 0 * base.phase_coefficients])
    phase[1, 0, 0] = 0.05
    level = np.stack(
        [base.transmission_coefficients, 0 * base.transmission_coefficients]
    )
    p = Proxy(phase, level, (0.08, 0.21), (0.84, 0.86), 0.0, 0.0, 2, math.radians(20))
    s = math.sin(math.radians(10)) / math.sin(math.radians(20))
    got = p.phase_rad(0.1, 0.85, math.radians(-10)) - base.phase_rad(0.1, 0.85)
    assert got == pytest.approx(0.05 * (2 * s**2 - 1), abs=1e-12)
    with pytest.raises(DomainError, match="holds up to"):
        p.phase_rad(0.1, 0.85, math.radians(21))


@settings(max_examples=100)
@given(st.floats(-1e4, 1e4), st.floats(0.84, 0.86), st.integers(1, 3))
def test_inverse_round_trip(phase, wavelength, power):
    p = proxy(power=power)
    d = p.diameter_um(np.array([phase]), wavelength)
    error = (p.phase_rad(d, wavelength) - phase + math.pi) % TURN - math.pi
    assert abs(error[0]) < 1e-10  # rounding of 1e4 rad is 2e-12


def test_inverse_gradient_is_one_over_the_slope():
    phase = torch.linspace(0, 6, 50, dtype=torch.float64, requires_grad=True)
    d = proxy().diameter_um(phase, 0.85)
    d.sum().backward()
    want = 1 / proxy().dphase_ddiameter(d.detach().numpy(), 0.85)
    assert phase.grad is not None
    assert abs(phase.grad.numpy() / want - 1).max() < 1e-12
    assert torch.autograd.gradcheck(
        lambda x: proxy().diameter_um(x, 0.85), phase, eps=1e-5, atol=1e-7
    )


def test_falling_phase_is_inverted_too():
    p = proxy()
    falling = Proxy(
        -p.phase_coefficients,
        p.transmission_coefficients,
        *(p.domain_um, p.wavelengths_um),
        0.0,
        0.0,
        2,
    )
    d = falling.diameter_um(np.linspace(-9, 9, 100), 0.85)
    error = (
        falling.phase_rad(d, 0.85) - np.linspace(-9, 9, 100) + math.pi
    ) % TURN - math.pi
    assert np.abs(error).max() < 1e-10


def test_branch_is_chosen_by_the_range():
    p = proxy(1.2)
    phase = p.phase_rad(0.205, 0.85)
    assert p.diameter_um(phase, 0.85) < 0.15  # the thinnest of the two pillars
    assert p.diameter_um(phase, 0.85, within_um=(0.12, 0.21)) == pytest.approx(
        0.205, abs=1e-9
    )


def test_less_than_a_turn_is_refused_or_taken_to_the_nearest_end():
    p = proxy(0.7)
    ends = p.phase_rad(np.array(p.domain_um), 0.85)
    cover = p.coverage_rad(0.85)
    assert cover == pytest.approx(ends[1] - ends[0])
    in_gap = np.array([[ends[0], ends[1] + 0.2, ends[0] - 0.2]])
    with pytest.raises(DomainError, match=r"index \(0, 1\): they cover 0\.70"):
        p.diameter_um(in_gap, 0.85)
    got = p.diameter_um(in_gap, 0.85, gap="nearest")
    assert np.allclose(got, [[0.08, 0.21, 0.08]], atol=1e-12)


def test_inverse_refuses_what_has_no_single_answer():
    wavy = proxy_of([0.0, 5.0, 0.0, 4.0], [0.9], (0.08, 0.2), 0.85)
    assert not wavy.monotone(0.85)
    assert wavy.monotone(0.85, within_um=(0.18, 0.2))
    with pytest.raises(DomainError, match="not monotone"):
        wavy.diameter_um(np.array([0.0]), 0.85)
    flat = proxy_of([1.0], [0.9], (0.08, 0.2), 0.85)
    with pytest.raises(DomainError, match="not monotone"):
        flat.diameter_um(np.array([0.0]), 0.85)
    with pytest.raises(DomainError, match="is not finite"):
        proxy().diameter_um(np.array([0.0, np.nan]), 0.85)
    with pytest.raises(DomainError, match="range inside"):
        proxy().diameter_um(np.array([0.0]), 0.85, within_um=(0.05, 0.2))
