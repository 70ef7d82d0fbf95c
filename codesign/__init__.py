"""Optics, pixel pitch and network optimised together for an eye in front of the lens.

Names load when first used: ``import codesign; codesign.render(states)``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
