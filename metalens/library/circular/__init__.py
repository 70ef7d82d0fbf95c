"""Libraries for circular light: what is converted to the other hand, and pillars turned
one by one.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.library.circular.turned import GeometricPhase as GeometricPhase
    from metalens.library.circular.turned import (
        check_geometric_phase as check_geometric_phase,
    )
    from metalens.library.circular.turned import solve_rotations as solve_rotations

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "GeometricPhase": "turned",
        "check_geometric_phase": "turned",
        "solve_rotations": "turned",
    },
)
