"""The lens that training moves; as made; with all numbers of the chain open."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
