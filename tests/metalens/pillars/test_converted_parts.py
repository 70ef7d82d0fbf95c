"""Which sizes a lens for circular light may use: far enough from resonances, and on the
widest run that a fit meets.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from metalens.ground.errors import DomainError
from metalens.pillars import converted
from metalens.pillars.fit import Data, Wanted

SIZES = np.linspace(0.1, 0.2, 101)


def test_sizes_within_two_half_widths_of_a_sharp_resonance_are_left_out():
    """Of half-widths 2.2 and 0.6 nm where 3 nm are the least, each to either side;
    broad ones are smooth.
    """
    rows = np.array(
        [
            [0, 0.0, 0.85, 0.1303, 2.2e-3],
            [1, 0.0, 0.85, 0.1652, 0.6e-3],
            [0, 0.0, 0.85, 0.18, 3.1e-3],
        ]
    )
    near = converted._sharp(SimpleNamespace(diameter_um=SIZES, resonances=rows), 3e-3)
    want = (np.abs(SIZES - 0.1303) <= 4.4e-3) | (np.abs(SIZES - 0.1652) <= 1.2e-3)
    assert near.tolist() == want.tolist()
    assert (near[:40].sum(), near[40:].sum()) == (9, 2)


def test_the_run_shrinks_about_the_best_size_until_the_fit_meets_its_tolerance():
    """A straight phase up to 0.16 um and a step of a radian there: runs about 0.14 that
    reach it are not met.
    """
    phase = 30 * (SIZES - 0.1) + (SIZES > 0.1605)
    data = Data(
        phase[None, None], np.ones((1, 1, 101)), SIZES, np.array([0.85]), np.zeros(1)
    )
    wanted = Wanted(
        coefficients=4, phase_tolerance_rad=1e-3, transmission_tolerance=1e-2
    )
    proxy = converted._widest(data, 40, wanted)
    low, high = proxy.domain_um
    assert high <= 0.1605
    assert (low + high) / 2 == pytest.approx(0.14, abs=1e-9)
    assert high - 0.14 > 0.9 * 0.02 - 2e-3  # a tenth less at a time
    assert proxy.max_phase_error_rad < 1e-3
    rough = Data(
        phase + 0.1 * (-1.0) ** np.arange(101)[None, None],
        data.level,
        SIZES,
        data.wavelength,
        data.angle,
    )
    low, high = converted._widest(rough, 40, wanted).domain_um
    assert round((high - low) / 1e-3) + 1 in (12, 13)  # the least that is fitted


WAVES = np.array([0.84, 0.85, 0.86])


def phase_of(d, wave):
    """Through the branch cut of the angle between the wavelengths at 0.14 um, and along
    the sizes.
    """
    return 3.0 + 25 * (d - 0.14) + 60 * (wave - 0.84) - 200 * (wave - 0.85) * (d - 0.14)


def library(width_um=0.08, resonances=(), t_error=None):
    """Converted light (t_x - t_y) / 2 whose level is a parabola with its top, 1, at
    0.14 um.
    """
    d, wave = SIZES, WAVES[:, None]
    wanted = (1 - ((d - 0.14) / width_um) ** 2) * np.exp(1j * phase_of(d, wave))
    common = 0.3 * np.exp(7j * d) + 0 * wave
    t = np.stack([common + wanted, common - wanted])[:, None]
    bars = np.zeros(t.shape) if t_error is None else np.broadcast_to(t_error, t.shape)
    lines = np.array(resonances, float).reshape(-1, 5)
    sweep = SimpleNamespace(bar=1e-3)
    about = {
        "wavelength_um": WAVES,
        "angle_rad": np.zeros(1),
        "resonances": lines,
        "sweep": sweep,
    }
    return SimpleNamespace(t=t, t_error=bars, diameter_um=d, **about)


@pytest.mark.parametrize(
    ("made", "within", "domain"),
    [
        (
            library(),
            None,
            (0.11, 0.17),
        ),  # 85 % of the top: 0.08 times the root of 0.15, 31 nm, to either side
        (library(width_um=0.3), None, (0.1, 0.2)),  # everywhere
        (library(width_um=0.3), (0.1145, 0.1855), (0.115, 0.185)),
        (library(resonances=[[0, 0, 0.85, 0.125, 1e-4]]), None, (0.126, 0.17)),
        (library(resonances=[[1, 0, 0.85, 0.163, 1e-4]]), None, (0.11, 0.162)),
    ],
)
def test_the_proxy_holds_the_widest_clean_run_of_sizes_about_the_best(
    made, within, domain
):
    proxy = converted.fit(made, Wanted(coefficients=24, within_um=within)).proxy
    assert proxy.domain_um == pytest.approx(domain, abs=1e-9)
    for wave in WAVES:
        off = proxy.phase_rad(SIZES[28:62], float(wave)) - phase_of(SIZES[28:62], wave)
        assert off - off[0] == pytest.approx(0, abs=1e-3)
        turns = (off[0] - (proxy.phase_rad(0.14, 0.84) - 3.0)) / (2 * np.pi)
        assert turns == pytest.approx(
            0, abs=1e-3
        )  # no turn is lost from one wavelength to the next


def test_a_run_of_fewer_than_twelve_sizes_is_refused():
    """Resonances at 0.134 and 0.145 um leave ten sizes between them, at 0.133 and 0.146
    um twelve.
    """

    def between(low, high):
        return library(resonances=[[0, 0, 0.85, low, 1e-4], [0, 0, 0.85, high, 1e-4]])

    with pytest.raises(DomainError, match=r"fewer than 12 sizes around 0\.14 um"):
        converted.fit(between(0.134, 0.145), Wanted())
    proxy = converted.fit(between(0.133, 0.146), Wanted()).proxy
    assert proxy.domain_um == pytest.approx((0.134, 0.145), abs=1e-9)


def test_the_best_size_is_off_resonances():
    """The top has bars above the tolerance within 2.5 nm: the next size is best; where
    all have, the top.
    """
    bars = np.where(np.abs(SIZES - 0.1402) < 2.5e-3, 2e-3, 1e-4)
    assert converted.best_size_um(library(t_error=bars)) == pytest.approx(
        0.137, abs=1e-9
    )
    assert converted.best_size_um(library(t_error=2e-3)) == pytest.approx(
        0.14, abs=1e-9
    )
