"""First-order changes of a layer between half-spaces: differences of the equations
written out, sums over points.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from metalens.modal import variation
from metalens.modal.homogeneous import Basis
from metalens.modal.layer import LayerModes, axial
from metalens.modal.match import HalfSpace
from metalens.modal.variation import Change, HalfRate, Waves

A, B, K0, STEP = 4, 3, 1.7, 1e-5
N = A + B


def symmetric(rng, size, most=1.0):
    drawn = rng.normal(size=(size, size)) * most
    return (drawn + drawn.T) / 2


def basis(zero=0, exact=None):
    """Drawn at will; ``exact``: of the zero order ``zero``."""
    rng = np.random.default_rng(8)
    te, tm = np.array([0.5, 4.1, 9.3, 33.0]), np.array([0.9, 8.2, 45.0])
    both = np.concatenate([te, tm])
    both[zero] = both[zero] if exact is None else exact
    half = (0.45 * np.eye(size) + 0.05 * symmetric(rng, size) for size in (N, A, B))
    mass, curl, scalar = half
    return Basis(
        te,
        tm,
        both[:A],
        both[A:],
        lambda: np.eye(N),
        np.eye(B),
        mass,
        20 * curl,
        scalar,
    )


def change():
    """All rates at once; of the curl of gradients, which stays nothing in the cell,
    too.
    """
    rng = np.random.default_rng(9)
    parts = [symmetric(rng, size, 0.5) for size in (N, N, B, N, N, B)]
    return Change(0.3, 0.7, -0.4, 0.2, *parts, 0.5 * rng.normal(size=(N, B)))


def embedded(block):
    out = np.zeros((N, N), block.dtype)
    out[:A, :A] = block
    return out


def written(form, b, s, disc, around):
    """(stiffness, 1 / growth) after ``s`` of the change."""
    c = change()
    k0, disc, around = K0 + s * c.k0, disc + s * c.disc, around + s * c.around
    mass, scalar = np.eye(N) + s * c.mass, np.eye(B) + s * c.scalar
    curl = np.diag(np.concatenate([b.te, np.zeros(B)])) + s * c.curl
    disc_mass, disc_scalar = (
        b.disc_mass + s * c.disc_mass,
        b.disc_scalar + s * c.disc_scalar,
    )
    gradient = np.vstack([np.zeros((A, B)), np.diag(np.sqrt(b.tm))]) + s * c.gradient
    if form == "electric":
        stiffness = curl - k0**2 * (around * mass + (disc - around) * disc_mass)
        weighed = k0**2 * (around * scalar + (disc - around) * disc_scalar)
        return stiffness, np.linalg.inv(mass) - gradient @ np.linalg.solve(
            weighed, gradient.T
        )
    inverse, step = 1 / around, 1 / disc - 1 / around
    stiffness = (
        inverse * curl + step * (embedded(b.disc_curl) + s * c.disc_curl) - k0**2 * mass
    )
    weighed = np.linalg.inv(inverse * mass + step * disc_mass)
    return stiffness, weighed - gradient @ np.linalg.solve(k0**2 * scalar, gradient.T)


FORMS = {"electric": variation.electric_rates, "magnetic": variation.magnetic_rates}


@pytest.mark.parametrize(("disc", "around"), [(5.3, 1.6), (2.1 + 0.4j, 3.7 + 0.1j)])
@pytest.mark.parametrize("form", list(FORMS))
def test_rates_of_the_layers_matrices_are_differences(form, disc, around):
    high, low = (written(form, basis(), s, disc, around) for s in (STEP, -STEP))
    found = FORMS[form](basis(), K0, disc, around, change())
    for got, a, b in zip(found, high, low, strict=True):
        want = (a - b) / (2 * STEP)
        assert (
            np.abs(got - want).max() < 1e-7 * np.abs(want).max()
        )  # third derivative: 1e-9; rounding 1e-10


def order(form, b, zero, s, permittivity, exact):
    """Admittance operator and source of a half-space: its own modes, but for the zero
    order's exact wavenumber.
    """
    c = change()
    k0 = K0 + s * c.k0
    stiffness, inverse = homogeneous(form, b, s, permittivity)
    square, fields = np.linalg.eig(-inverse @ stiffness)
    q = axial(square)
    growth = np.linalg.inv(inverse)
    operator = growth @ ((fields * (1j * q)) @ np.linalg.inv(fields))
    which = int(np.abs(fields[zero]).argmax())
    mass = np.eye(N) + s * c.mass
    field = fields[:, which] / np.sqrt(fields[:, which] @ mass @ fields[:, which])
    field = field * np.sign(field[zero].real)
    dual = mass @ field
    kz = axial(np.array(k0**2 * permittivity - (np.sqrt(exact) + s * c.bloch) ** 2))
    te, tm = (1 / permittivity, 1.0) if form == "magnetic" else (1.0, permittivity)
    y_exact = 1j * kz * te if zero < A else 1j * k0**2 * tm / kz
    y = field @ operator @ field
    return operator + (y_exact - y) * np.outer(dual, dual), np.sqrt(y_exact) * dual


def homogeneous(form, b, s, permittivity):
    """As ``written`` of one medium, whose permittivity stays."""
    c = change()
    k0 = K0 + s * c.k0
    mass, scalar = np.eye(N) + s * c.mass, np.eye(B) + s * c.scalar
    curl = np.diag(np.concatenate([b.te, np.zeros(B)])) + s * c.curl
    gradient = np.vstack([np.zeros((A, B)), np.diag(np.sqrt(b.tm))]) + s * c.gradient
    e = permittivity
    left, right, weight = (
        (curl, mass, e) if form == "electric" else (curl / e, mass / e, 1.0)
    )
    stiffness = left - k0**2 * e * right
    inverse = np.linalg.inv(mass if form == "electric" else right)
    return stiffness, inverse - gradient @ np.linalg.solve(
        k0**2 * weight * scalar, gradient.T
    )


@pytest.mark.parametrize("zero", [0, A])
@pytest.mark.parametrize("form", list(FORMS))
def test_rates_of_a_half_space_are_differences(form, zero):
    """The zero order, of either family, has its own wavenumber 0.2 beside that of the
    mesh.
    """
    e = 2.3
    plain = [0.5, 0.9][zero == A]
    b = basis(zero, plain + 0.2)
    exact = np.concatenate([b.te_exact, b.tm_exact])
    kz = axial(K0**2 * e - exact)
    te, tm = (1 / e, 1.0) if form == "magnetic" else (1.0, e)
    half = HalfSpace(
        np.concatenate([1j * kz[:A] * te, 1j * K0**2 * tm / kz[A:]]),
        np.flatnonzero(kz.real > 0),
    )
    found = variation.half_space_rate(
        b, half, zero, K0, e, change(), magnetic=form == "magnetic"
    )
    high, low = (order(form, b, zero, s, e, plain + 0.2) for s in (STEP, -STEP))
    for got, a, c in zip((found.admittance, found.source), high, low, strict=True):
        want = (a - c) / (2 * STEP)
        assert (
            np.abs(got - want).max() < 1e-6 * np.abs(want).max()
        )  # third derivative: 1e-9; rounding of modes


@pytest.mark.parametrize("zero", [1, A + 2])
@pytest.mark.parametrize("magnetic", [False, True])
def test_rates_in_the_permittivity_are_differences(zero, magnetic):
    b = basis(zero, 1.3)
    square = np.concatenate([b.te_exact, b.tm_exact])

    def admittance(e):
        kz = axial(K0**2 * e - square)
        te, tm = (1 / e, 1.0) if magnetic else (1.0, e)
        return np.concatenate([1j * kz[:A] * te, 1j * K0**2 * tm / kz[A:]])

    found = variation.half_space_by_permittivity(
        b, HalfSpace(admittance(2.3), np.array([0])), zero, K0, 2.3, magnetic=magnetic
    )
    want = (admittance(2.3 + STEP) - admittance(2.3 - STEP)) / (2 * STEP)
    assert np.diag(found.admittance) == pytest.approx(
        want, rel=1e-7
    )  # third derivative: 1e-9; rounding
    assert np.count_nonzero(found.admittance) == N
    root = (np.sqrt(admittance(2.3 + STEP)) - np.sqrt(admittance(2.3 - STEP))) / (
        2 * STEP
    )
    assert found.source[zero] == pytest.approx(root[zero], rel=1e-7)
    assert np.count_nonzero(found.source) == 1


HEIGHT = 1.3
Q = np.array([2.1, 0.4 + 1.9j, 2.1 + 1e-7j, 5.5j])
POINT, WEIGHT = np.polynomial.legendre.leggauss(40)
Z, DZ = (POINT + 1) * HEIGHT / 2, WEIGHT * HEIGHT / 2


def test_overlaps_of_modes_are_integrals_over_the_height():
    along, against = variation.overlaps(Q, HEIGHT)
    up, down = np.exp(1j * Q[:, None] * Z), np.exp(1j * Q[:, None] * (HEIGHT - Z))
    assert along == pytest.approx((up * DZ) @ up.T, abs=1e-12)
    assert against == pytest.approx((up * DZ) @ down.T, abs=1e-12)
    # sums that are small, to both sides of where a series takes over, and beyond any
    # number
    for sum_ in (0.0, 0.7e-5, 0.9e-5, 1.1e-5, 1e-3):
        along, _ = variation.overlaps(np.array([3.0, sum_ / HEIGHT - 3.0]), HEIGHT)
        want = 1 - sum_**2 / 6 + 1j * (sum_ / 2 - sum_**3 / 24)
        assert along[0, 1] / HEIGHT == pytest.approx(want, abs=1e-15 + 1e-2 * sum_**4)
    far = variation.overlaps(np.array([2000j, 0.1]), HEIGHT)
    assert all(np.isfinite(one).all() for one in far)


def modes():
    rng = np.random.default_rng(4)
    field, partner = (
        rng.normal(size=(4, 4)) + 1j * rng.normal(size=(4, 4)) for _ in range(2)
    )
    up, down = (
        rng.normal(size=(4, 2)) + 1j * rng.normal(size=(4, 2)) for _ in range(2)
    )
    rates = symmetric(rng, 4) + 0.3j * symmetric(rng, 4), symmetric(rng, 4)
    return LayerModes(Q, field, partner), Waves(up, down), rates


def at(layer, w, z):
    """u and p of both ports at a height: up from the foot, down from the top."""
    rise, fall = (
        np.exp(1j * Q * z)[:, None] * w.up,
        np.exp(1j * Q * (HEIGHT - z))[:, None] * w.down,
    )
    return layer.field @ (rise + fall), layer.partner @ (
        1j * Q[:, None] * (rise - fall)
    )


def test_the_layers_part_is_the_integral_of_its_fields():
    """∫ (p·dN p - u·dS u) dz, rates given as (dS, dN)."""
    layer, w, rates = modes()
    want = np.zeros((2, 2), complex)
    for z, dz in zip(Z, DZ, strict=True):
        u, p = at(layer, w, z)
        want += dz * (p.T @ rates[1] @ p - u.T @ rates[0] @ u)
    assert variation.layer_rate(layer, w, HEIGHT, rates) == pytest.approx(
        want, rel=1e-11
    )


def test_the_scattering_matrix_moves_by_sources_and_half_of_all_inside():
    layer, w, rates = modes()
    rng = np.random.default_rng(6)
    halves = tuple(
        HalfRate(symmetric(rng, 4) + 0j, rng.normal(size=4) + 1j * rng.normal(size=4))
        for _ in range(2)
    )
    (foot, _), (top, _) = at(layer, w, 0.0), at(layer, w, HEIGHT)
    inner = variation.layer_rate(layer, w, HEIGHT, rates)
    inner = (
        inner
        + foot.T @ halves[0].admittance @ foot
        + top.T @ halves[1].admittance @ top
    )
    want = -inner / 2
    for i, (source, field) in enumerate(
        ((halves[0].source, foot), (halves[1].source, top))
    ):
        for j in (0, 1):
            want[i, j] += source @ field[:, j]
            want[j, i] += source @ field[:, j]
    assert variation.matrix_rate(layer, w, HEIGHT, rates, halves) == pytest.approx(
        want, rel=1e-12
    )


def test_amplitudes_are_those_that_come_from_the_other_end_and_from_the_ports():
    """Two of four modes carry; three ports below, two above."""
    rng = np.random.default_rng(7)

    def drawn(*shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    foot, top = (
        SimpleNamespace(back=np.zeros((p, p)), inward=drawn(4, 2 + p)) for p in (3, 2)
    )
    match = SimpleNamespace(
        carry=np.array([3, 1]), foot=foot, top=top, amplitude=drawn(4, 5)
    )
    layer, *_ = modes()
    found = variation.waves(match, layer, HEIGHT, 2, 1)
    x = np.exp(1j * Q[[3, 1]] * HEIGHT)
    for column, port in ((0, 2), (1, 3 + 1)):
        rise, fall = match.amplitude[:2, port] * x, match.amplitude[2:, port] * x
        up, down = foot.inward[:, :2] @ fall, top.inward[:, :2] @ rise
        for place, mode in enumerate((3, 1)):
            up[mode] -= fall[place]
            down[mode] -= rise[place]
        up = up + (foot.inward[:, 2 + 2] if column == 0 else 0)
        down = down + (top.inward[:, 2 + 1] if column == 1 else 0)
        assert found.up[:, column] == pytest.approx(up)
        assert found.down[:, column] == pytest.approx(down)


def test_gradients_have_the_root_of_their_wavenumber():
    raised = variation.raise_gradient(basis())
    assert raised.shape == (N, B)
    assert not raised[:A].any()
    assert raised[A:] == pytest.approx(np.diag(np.sqrt([0.9, 8.2, 45.0])))
