"""One self-contained page to explore an artefact: figures that can be turned, their
numbers next to them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
