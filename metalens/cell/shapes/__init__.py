"""The section of a pillar as one record: outline, area, Fourier factors, boundary, mask
polygon, name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
