"""Options of the verbs of co-design, without their work: what ``--help`` shows needs
neither torch nor time.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
