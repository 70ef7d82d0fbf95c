"""Image formation: PSFs that vary over field, depth and spectrum; scenes, sensors, and
the Fisher information of images.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
