"""Process variation: one table of fabrication perturbations with their derivatives,
states of them, their spread, and the bias of a mask.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
