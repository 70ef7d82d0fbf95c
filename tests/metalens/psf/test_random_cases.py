"""PSFs of random lenses, windows, films and directions against plain sums: the error is
within what the stack states.
"""

import numpy as np
import pytest

from metalens import psf
from tests.referees import random_psf


@pytest.mark.parametrize("seed", range(24))
def test_the_error_of_a_random_case_is_below_its_estimate(seed):
    """Relative L2 of all depths together, which the tolerance is about. The plain sum
    rounds at 1e-12. Maps in float32 round phases of hundreds of turns: wrapped first.
    """
    rng = np.random.default_rng([64, seed])
    case = random_psf.drawn(rng)
    want, energy = random_psf.plain_psfs(case)
    kind = np.float32 if case.tolerance > 1e-5 and rng.random() < 0.5 else np.float64
    maps = [np.angle(np.exp(1j * case.maps[0])), case.maps[1]]
    stack = psf.psf_stack(
        *(one.astype(kind) for one in maps),
        **case.geometry,
        tolerance=case.tolerance,
        integrate=False,
    )
    error = np.linalg.norm(stack.intensity - want) / np.linalg.norm(want)
    assert error <= stack.error + 2e-12
    assert stack.converged
    assert stack.energy_um2 == pytest.approx(energy, rel=6 * stack.error + 1e-11)
