"""Stacks of layers and films beside one system of equations for all amplitudes at once,
interface by interface.
"""

import numpy as np
import pytest

from metalens.rcwa import stack
from metalens.rcwa.layer import solve_eigenmodes
from metalens.rcwa.orders import basis
from metalens.rcwa.orders.waves import half_space, normal_component, plane_waves
from metalens.rcwa.stack import StackMedia

WAYS = plane_waves(
    basis.disc_basis(1, "none"),
    pitch_um=0.47,
    wavelength_um=0.83,
    kx=0.31,
    ky=-0.17,
    azimuth_rad=0.6,
)
N = len(WAYS.kappa)
BELOW, ABOVE = 1.45, 1.2
UNDER, OVER = ((1.9, 0.7), (1.6 + 0.1j, 1.3)), ((1.3, 0.9), (2.1, 0.4))


def drawn(seed, *, symmetric, batch=()):
    """Operators near those of a medium, and their modes."""
    rng = np.random.default_rng(seed)
    P, Q = (
        0.15
        * (rng.normal(size=(*batch, N, N)) + 1j * rng.uniform(0, 1, (*batch, N, N)))
        for _ in range(2)
    )
    if symmetric:
        P, Q = (A + np.swapaxes(A, -1, -2) for A in (P, Q))
    p = np.arange(N) < WAYS.p_count
    P = P + np.diag(np.where(p, 1 - WAYS.kappa**2 / 5, 1.0))
    Q = Q + np.diag(np.where(p, 5.0, 5.0 - WAYS.kappa**2))
    return solve_eigenmodes(P, Q, symmetric=symmetric)


def film(index, height):
    """(W, V, q, height) of plane waves up."""
    U, V = half_space(WAYS, index)
    return np.diag(U), np.diag(V), normal_component(WAYS.kappa, index), height


def directly(inner, incident):
    """(r, [(up, down)], t) where every tangential field is continuous; inner: (W, V, q,
    height) of each layer.

    Waves up have their phase at the foot of a layer, waves down at its top.
    """
    below, above = half_space(WAYS, BELOW), half_space(WAYS, ABOVE)
    sides = [
        (np.diag(below[0]), np.diag(below[1]), None, 0.0),
        *inner,
        (np.diag(above[0]), np.diag(above[1]), None, 0.0),
    ]
    count = 2 * (len(inner) + 1) * N
    system, right = np.zeros((count, count), complex), np.zeros(count, complex)
    for k in range(len(inner) + 1):
        rows = slice(2 * k * N, 2 * (k + 1) * N)
        for medium, sign, at_top in ((k, 1, True), (k + 1, -1, False)):
            W, V, q, height = sides[medium]
            fade = np.ones(N) if q is None else np.exp(1j * q * height)
            up = np.vstack([W, V]) * (fade if at_top else 1.0)
            down = np.vstack([W, -V]) * (1.0 if at_top else fade)
            first = (
                2 * medium - 1
            ) * N  # the substrate has waves down alone as unknowns, the cover waves up
            if medium == 0:
                right[rows] -= sign * up @ incident
                system[rows, :N] += sign * down
            else:
                system[rows, first : first + N] += sign * up
                if medium <= len(inner):
                    system[rows, first + N : first + 2 * N] += sign * down
    found = np.linalg.solve(system, right)
    layers = [
        found[(2 * k + 1) * N : (2 * k + 3) * N].reshape(2, N)
        for k in range(len(inner))
    ]
    return found[:N], layers, found[-N:]


def inner_of(parts, heights):
    return [
        (part.W, part.V, part.q, height)
        for part, height in zip(parts, heights, strict=True)
    ]


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize(
    "heights", [(1.1, 0.6), (35.0, 0.6)], ids=["thin", "one in which waves fade"]
)
def test_fields_between_half_spaces_are_those_of_all_equations_at_once(
    symmetric, heights
):
    parts = [drawn(seed, symmetric=symmetric) for seed in (1, 2)]
    rng = np.random.default_rng(4)
    incident = rng.normal(size=N) + 1j * rng.normal(size=N)
    below, above = half_space(WAYS, BELOW), half_space(WAYS, ABOVE)
    found = stack.match_layers(
        parts, heights, above, below, 2 * below[0] * below[1] * incident
    )
    r, layers, t = directly(inner_of(parts, heights), incident)
    assert found.u == pytest.approx(below[0] * (incident + r), abs=1e-9)
    assert found.w == pytest.approx(below[1] * (incident - r), abs=1e-9)
    assert found.u_top == pytest.approx(above[0] * t, abs=1e-9)
    assert found.w_top == pytest.approx(above[1] * t, abs=1e-9)
    for got, want in zip(zip(found.up, found.down, strict=True), layers, strict=True):
        assert got[0] == pytest.approx(want[0], abs=1e-8)
        assert got[1] == pytest.approx(want[1], abs=1e-8)
    assert stack.outgoing_amplitudes(above, found.u_top, found.w_top) == pytest.approx(
        t, abs=1e-9
    )


def test_a_batch_is_each_of_its_layers_alone():
    """Of which one has waves that fade away and the other has not."""
    part = drawn(7, symmetric=True, batch=(2,))
    below, above = half_space(WAYS, BELOW), half_space(WAYS, ABOVE)
    source = 2 * below[0] * below[1] * (1 + np.arange(N))
    both = stack.match_layers([part], (9.0,), above, below, source)
    for i in range(2):
        alone = stack.match_layers(
            [solve_eigenmodes(part.P[i], part.Q[i])], (9.0,), above, below, source
        )
        for name in ("u", "w", "u_top", "w_top"):
            assert getattr(both, name)[i] == pytest.approx(
                getattr(alone, name), abs=1e-9
            )


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("layers", [0, 2])
def test_amplitudes_of_a_whole_stack_are_those_of_all_equations_at_once(
    layers, symmetric
):
    """Films below and above, the first one met first; amplitudes times the roots of
    their power over the light's.
    """
    zero = WAYS.zero_p
    parts, heights = (
        [drawn(seed, symmetric=symmetric) for seed in (1, 2)[:layers]],
        (1.1, 0.6)[:layers],
    )
    media = StackMedia(BELOW, ABOVE, UNDER, OVER, heights)
    got = stack.scatter_zero_order(WAYS, media, parts, zero)
    incident = np.zeros(N, complex)
    incident[zero] = 1.0
    inner = [
        *(film(*one) for one in UNDER),
        *inner_of(parts, heights),
        *(film(*one) for one in OVER),
    ]
    r, _, t = directly(inner, incident)
    power = []
    for index in (BELOW, ABOVE):
        kz = np.sqrt(
            index**2 - WAYS.kappa**2 + 0j
        )  # S_z of unit amplitude: kz of s, and of p as well
        power.append(kz.real)
    assert got.t == pytest.approx(t * np.sqrt(power[1] / power[0][zero]), abs=1e-9)
    assert got.r == pytest.approx(r * np.sqrt(power[0] / power[0][zero]), abs=1e-9)
    assert np.abs(got.t).max() > 0.1


def test_power_is_that_of_waves_that_propagate():
    u, v = (
        np.array([0.8, 0.3j, 2.0, 1.0, 1.0]),
        np.array([1.5, 2.0, 0.5 + 0.5j, 2.9e-12 + 3j, 3.1e-12 + 3j]),
    )
    assert stack.power_flux((u, v)) == pytest.approx(
        [1.2, 0.0, 1.0, 0.0, 3.1e-12], rel=1e-9
    )


def test_an_amplitude_is_read_from_whichever_field_is_large():
    a = np.array([2.0 - 1j, 0.3j, 5.0])
    U, V = np.array([1e-14, 3.0 + 1j, 2.0]), np.array([4.0 - 2j, 1e-14, -1.5j])
    assert stack.outgoing_amplitudes((U, V), U * a, V * a) == pytest.approx(
        a, rel=1e-12
    )
    # of fields that do not belong together it is the nearest in both
    off = stack.outgoing_amplitudes((U[2:], V[2:]), U[2:] * a[2] + 0.1, V[2:] * a[2])
    assert off == pytest.approx([5.0 + 2 * 0.1 / (4 + 2.25)], rel=1e-12)


@pytest.mark.parametrize("thickness", [0.0, 1e-3, 0.8])
def test_a_film_at_grazing_incidence_of_a_wave_is_its_limit(thickness):
    """kz = 0 exactly: sin(kz t) / kz becomes t; beside it a film whose kz is 1e-6."""
    index = float(WAYS.kappa[WAYS.zero_s])
    pair = half_space(WAYS, ABOVE)
    (u, w), fade = stack._through(WAYS, pair, ((index, thickness),))
    (u_near, w_near), _ = stack._through(WAYS, pair, ((index + 1e-12, thickness),))
    assert np.isfinite([u, w, fade]).all()
    assert u == pytest.approx(u_near, abs=1e-5)
    assert w == pytest.approx(w_near, abs=1e-5)
    at = WAYS.zero_s
    assert u[at] == pytest.approx(pair[0][at] - 1j * thickness * pair[1][at], abs=1e-9)
    assert w[at] == pytest.approx(pair[1][at], abs=1e-9)
    assert fade[at] == pytest.approx(1.0, abs=1e-9)
