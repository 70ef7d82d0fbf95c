"""Light from a point source through the pillars to the sensor window: the exact sum,
and faster ways to the same field.

``exact`` is the reference, ``windowed`` the fast field; ``choose_method`` says which
method a stack of PSFs takes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
