"""Libraries over two sizes: the width and the length of a rectangle, or both axes of an
ellipse.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
