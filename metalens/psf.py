"""Point spread functions of a lens over depth, field angle and wavelength (paper Sec. 3.1, Eqs. 1-3).

``psf_stack`` takes phase and transmission maps, ``from_lens`` a lens file's content; ``on_pixels`` gives what a sensor
sees; ``save`` and ``load`` keep a stack as a file.
"""

from metalens.psf_lens import View, depth_samples, from_lens
from metalens.psf_maps import psf_stack
from metalens.psf_pixels import on_pixels
from metalens.psf_record import PsfStack, load, save

__all__ = ["PsfStack", "View", "depth_samples", "from_lens", "load", "on_pixels", "psf_stack", "save"]
