"""A corrected mask in numbers: overlaps of waves, the table that a posterior asks for,
units for people.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from codesign.adapt import correction
from codesign.adapt.correction import MaskCorrection
from metalens.lens import DiameterMap

RNG = np.random.default_rng(29)

FORM_KEPT = SimpleNamespace(by_edges=lambda diameter_um: None)


def test_an_overlap_is_the_strehl_ratio_with_the_best_piston():
    """exp(-V) to second order for a phase of variance V; 1 for a wave times any number."""
    wave = RNG.normal(size=(30, 40)) + 1j * RNG.normal(size=(30, 40))
    assert correction.wavefront_overlap(wave, (0.3 - 1.7j) * wave) == pytest.approx(
        1.0, rel=1e-12
    )
    one, other = np.array([1.0, 2j, 0.5]), np.array([0.7, 1.0 + 1j, -0.2])
    cross = abs(1.0 * 0.7 + (-2j) * (1 + 1j) + 0.5 * -0.2) ** 2
    assert correction.wavefront_overlap(one, other) == pytest.approx(
        cross / (5.25 * (0.49 + 2 + 0.04)), rel=1e-12
    )
    off = 0.05 * RNG.normal(size=100_000)
    turned = correction.wavefront_overlap(np.exp(1j * off), np.ones(100_000))
    assert turned == pytest.approx(np.exp(-off.var()), abs=1e-5)


@pytest.fixture
def process(monkeypatch):
    """Pillars whose phase is 20 D as meant, and 20 (D - 0.012) + 0.3 as it is, which is
    0.06 more; bias 4 nm.
    """
    monkeypatch.setattr(
        correction,
        "transmission",
        lambda proxy, response, d, wave, answers: np.exp(
            1j * (20 * (d - answers) + 25 * answers)
        ),
    )

    class State(dict):
        def answers(self):
            return self["off"]

        @classmethod
        def of(cls):
            return cls(off=0.0)

    monkeypatch.setattr(correction, "State", State)
    monkeypatch.setattr(
        correction,
        "process_state_of",
        lambda x: State(off=0.012 if x is not None else 0.0, bias_nm=4.0),
    )
    diameters = DiameterMap(np.array([[0.12, 0.0], [0.18, 0.26]]), 0.4)
    return SimpleNamespace(
        proxy=SimpleNamespace(domain_um=(0.06, 0.34)),
        diameters=diameters,
        wavelength_um=0.85,
        profile="typed",
    )


def test_made_diameters_are_wanted_that_give_the_designed_phases_up_to_a_piston(
    process,
):
    """All shifted alike: the shift is a piston, so nothing is wanted to change; the
    table is the present bias.
    """
    wanted = correction._wanted_um(process, np.array([0.12, 0.19, 0.26]), 1, FORM_KEPT)
    assert wanted == pytest.approx([0.12, 0.19, 0.26], abs=1e-6)
    old = SimpleNamespace(drawn_nm=lambda made: np.asarray(made) - 11.0)
    table = correction.bias_table(
        process, 1, response=FORM_KEPT, old=old, range_um=(0.12, 0.26), knots=5
    )
    assert table.designed_um == pytest.approx(np.linspace(0.12, 0.26, 5))
    assert table.bias_nm == pytest.approx(
        np.full(5, 15.0), abs=1e-3
    )  # 11 of the old table and 4 of the fit
    assert table.drawn_nm == pytest.approx(np.linspace(120, 260, 5) - 15.0, abs=1e-3)


def test_the_range_is_that_of_the_pillars_that_stand():
    lens = SimpleNamespace(
        diameters=SimpleNamespace(diameter_um=np.array([[0.0, 0.21], [0.14, 0.33]]))
    )
    assert correction.printed_um(lens) == (0.14, 0.33)


def test_rows_for_people_are_in_nanometres():
    made = MaskCorrection(
        np.array([100.0]),
        np.array([7.0]),
        np.array([5.0]),
        np.array([0.107]),
        np.array([0.111]),
        None,
    )
    assert correction.table_rows(made) == [
        pytest.approx((100.0, 5.0, 7.0, 107.0, 111.0))
    ]
