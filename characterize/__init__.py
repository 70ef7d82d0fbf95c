"""Bench captures to the as-built lens, with its uncertainty.

Names load when first used: ``import characterize; characterize.fit(capture, lens)``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
