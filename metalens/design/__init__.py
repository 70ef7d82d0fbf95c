"""Target phases, their assignment to pillars, and the check of the focus."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
