"""A lens: pillar diameters on a lattice with their cell, their proxy, and the films
around them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
