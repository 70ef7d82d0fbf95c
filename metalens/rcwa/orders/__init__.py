"""Fourier orders of a square cell under its mirrors, and of any lattice under what it
shares with shape and light.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
