"""Point spread functions of a lens over depth, field angle and wavelength (paper Sec.
3.1, Eqs. 1-3).

``psf_stack`` takes phase and transmission maps, ``from_lens`` a lens file's content;
``on_pixels`` gives what a sensor
sees; ``save`` and ``load`` keep a stack as a file.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
