"""Derivatives of the Jones matrices of any pillar by every number of its shape, section
and material.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
