"""Integrals over the height of a layer between any two modes, by quadrature, and fields
at its foot.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate

from metalens.rcwa.layer import FourierModes
from metalens.rcwa.rates import kernels
from metalens.rcwa.rates.regions import RegionFields, RegionModes

HEIGHT = 2.3
ROWS = np.array([1.7 + 0.02j, 2.9, 0.4j, 1.31 + 0.6j])
COLUMNS = np.array(
    [1.7 + 0.02j, 1.7 + 0.03j, 1.9, 2.9 + 0.26j, 2.9 + 0.27j, 0.5j, 3.3]
)  # alike, near, at 0.3, apart


def modes(q):
    return RegionModes(SimpleNamespace(q=q), HEIGHT)


def quadrature(wave):
    parts = (
        integrate.quad(lambda z, p=part: getattr(wave(z), p), 0, HEIGHT, epsabs=1e-13)
        for part in ("real", "imag")
    )
    return complex(*(value for value, _ in parts))


@pytest.mark.parametrize(
    ("integrals", "factor"),
    [
        (kernels.mode_integrals, lambda z: 1.0),
        (kernels.weighted_mode_integrals, lambda z: z / HEIGHT - 0.5),
    ],
)
def test_integrals_of_two_modes_are_those_of_their_exponentials(integrals, factor):
    same, opposite = integrals(modes(ROWS), modes(COLUMNS))
    for i, q in enumerate(ROWS):
        for j, p in enumerate(COLUMNS):
            one = quadrature(lambda z, q=q, p=p: factor(z) * np.exp(1j * (q + p) * z))
            other = quadrature(
                lambda z, q=q, p=p: (
                    factor(z) * np.exp(1j * q * z + 1j * p * (HEIGHT - z))
                )
            )
            assert same[i, j] == pytest.approx(one, abs=1e-12)
            assert opposite[i, j] == pytest.approx(
                other, abs=1e-11
            )  # 0.3⁹ / 4e6: the series' next term


def test_slopes_between_modes_that_hardly_differ_follow_their_series_to_its_end():
    """h² / 12 (q - p) for straight ones; half phases of 0.02 to 0.34 to the digits of a
    quadrature.
    """
    q = np.array([1.1])
    for half in (0.0, 0.02, 0.17, 0.29, 0.31, 0.34):
        p = q - 2 * half / HEIGHT
        _, opposite = kernels.weighted_mode_integrals(modes(q), modes(p))
        want = quadrature(
            lambda z, p=p: complex(
                (z / HEIGHT - 0.5) * np.exp(1j * q[0] * z + 1j * p[0] * (HEIGHT - z))
            )
        )
        assert opposite[0, 0] == pytest.approx(
            want, abs=1e-11
        )  # 0.3⁹ / 4e6: the next term
        _, opposite = kernels.mode_integrals(modes(q), modes(p))
        want = quadrature(
            lambda z, p=p: complex(np.exp(1j * q[0] * z + 1j * p[0] * (HEIGHT - z)))
        )
        assert opposite[0, 0] == pytest.approx(want, abs=1e-12)


def layer(seed, n=3):
    """Random modes of an operator without any symmetry: V = Q W / q, P V = W q."""
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    Q = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
    q = rng.uniform(0.5, 2, n) + 1j * rng.uniform(0.1, 0.4, n)
    V = Q @ W / q
    P = W * q @ np.linalg.inv(V)
    return FourierModes(P, Q, q, W, V, symmetric=False)


def waves(rng, n, k):
    up, down = (
        rng.normal(size=(n, k)) + 1j * rng.normal(size=(n, k)) for _ in range(2)
    )
    return RegionFields(up, down, np.zeros((1, 0, k)))


def field(part, waves, z):
    """(u, w) at a height, from up at the foot and down at the top."""
    up = np.exp(1j * part.q * z)[:, None] * waves.up
    down = np.exp(1j * part.q * (HEIGHT - z))[:, None] * waves.down
    return part.W @ (up + down), part.V @ (up - down)


def test_rates_of_an_upright_layer_are_the_integrals_of_its_fields():
    """i times the integral of u~ dQ u - w~ dP w, dP between some waves alone; dP and dQ
    even in height, or as the share
    of it above its middle, where modes that go down see the other sign."""
    rng = np.random.default_rng(5)
    back, light = layer(1), layer(2)
    sent, comes = waves(rng, 3, 2), waves(rng, 3, 4)
    z = slice(1, 3), slice(0, 2)
    dP, dQ = rng.normal(size=(2, 2)), rng.normal(size=(3, 3))
    nodes, weights = np.polynomial.legendre.leggauss(40)
    heights = HEIGHT * (nodes + 1) / 2
    sides = RegionModes(back, HEIGHT), RegionModes(light, HEIGHT)
    turned = kernels.in_modes(*sides, z, (dP, dQ))
    for integrals, sign, factor in (
        (kernels.mode_integrals, 1, 1 + 0 * nodes),
        (kernels.weighted_mode_integrals, -1, nodes / 2),
    ):
        want = 0
        for height, weight in zip(heights, weights * factor * HEIGHT / 2, strict=True):
            (u_back, w_back), (u, w) = (
                field(back, sent, height),
                field(light, comes, height),
            )
            want = want + weight * 1j * (
                u_back.T @ dQ @ u - w_back[z[0]].T @ dP @ w[z[1]]
            )
        got = kernels.upright_rates(turned, integrals(*sides), sign, sent, comes)
        assert got == pytest.approx(want, abs=1e-10)


def test_a_unit_of_height_adds_what_the_operators_make_of_the_fields_at_the_foot():
    rng = np.random.default_rng(6)
    part, n = layer(3), 3
    turned = RegionModes(
        FourierModes(
            part.P.T,
            part.Q.T,
            part.q,
            np.linalg.inv(part.V).T,
            np.linalg.inv(part.W).T,
            symmetric=False,
        ),
        HEIGHT,
    )
    sent, comes = waves(rng, n, 2), waves(rng, n, 4)
    (u, w), (u_back, w_back) = field(part, comes, 0.0), field(turned.part, sent, 0.0)
    want = 1j * (u_back.T @ part.Q @ u - w_back.T @ part.P @ w)
    this = SimpleNamespace(plain=RegionModes(part, HEIGHT), transposed=turned)
    assert kernels.height_rates(this, sent, comes) == pytest.approx(want, rel=1e-10)
    (later, late), (back, backs) = (
        field(part, comes, 0.7),
        field(turned.part, sent, 0.7),
    )
    assert 1j * (back.T @ part.Q @ later - backs.T @ part.P @ late) == pytest.approx(
        want, rel=1e-9
    )  # at any height
