"""Libraries for circular light: what is converted to the other hand, and pillars turned
one by one.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.pillars.circular.turned import Turned as Turned
    from metalens.pillars.circular.turned import check as check
    from metalens.pillars.circular.turned import solve as solve

__getattr__, __dir__, __all__ = attach(
    __name__,
    {"Turned": "turned", "check": "turned", "solve": "turned"},
)
