"""Libraries for circular light: what is converted to the other hand, and pillars turned
one by one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
