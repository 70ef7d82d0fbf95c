"""A stack of several wavelengths holds them with their weights, as they were asked for
and of sum 1.
"""

import numpy as np

from metalens.psf import psf_stack


def test_wavelengths_and_their_weights_are_not_exchanged():
    phase = np.random.default_rng(3).uniform(0, 2 * np.pi, (2, 8, 9))
    made = psf_stack(
        phase,
        np.ones((2, 8, 9)),
        pitch_um=0.4,
        wavelength_um=[0.83, 0.87],
        weights=[3.0, 7.0],
        sensor_distance_um=40.0,
        depths_um=[np.inf],
        window_um=6.0,
        samples=8,
        tolerance=1e-2,
    )
    assert np.asarray(made.wavelengths_um).tolist() == [0.83, 0.87]
    assert np.allclose(
        np.asarray(made.weights) / np.sum(made.weights), [0.3, 0.7], rtol=1e-12
    )
