"""Optics core: pillar library, proxy, lenses, wave propagation, PSF stacks, image
formation, information.

Submodules load when first used: ``import metalens; metalens.psf.psf_stack(...)``.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
