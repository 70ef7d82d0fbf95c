"""How exact results are where nobody says: part of the public surface, so changing it
changes the contract.
"""

import inspect

import pytest

from metalens import modal, propagate, psf, rcwa


@pytest.mark.parametrize(
    ("verbs", "tolerance"),
    [
        ((modal.solve, rcwa.solve, rcwa.solve_many, rcwa.jones), 1e-3),
        ((psf.psf_stack, psf.from_lens, propagate.windowed), 1e-4),
    ],
)
def test_solvers_take_a_thousandth_and_images_a_ten_thousandth(verbs, tolerance):
    for verb in verbs:
        assert inspect.signature(verb).parameters["tolerance"].default == tolerance, (
            verb.__qualname__
        )
