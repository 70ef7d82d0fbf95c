"""A modal method for round pillars: exact along z, elements that follow the disc
across.

``solve`` gives one response with its error estimate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
