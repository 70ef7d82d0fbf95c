"""A lens as built is computed to the accuracy of a design where nobody says another."""

import inspect

from characterize.model import made
from metalens.psf import psf_stack


def test_psfs_of_a_made_lens_are_as_accurate_as_those_of_the_design():
    one, other = (
        inspect.signature(verb).parameters["tolerance"].default
        for verb in (made.psf_stack, psf_stack)
    )
    assert one == other
