"""Libraries over two sizes: the width and the length of a rectangle, or both axes of an
ellipse.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.pillars.axes.between import surface as surface
    from metalens.pillars.axes.plots import figure as figure
    from metalens.pillars.axes.record import KIND as KIND
    from metalens.pillars.axes.record import AxesLibrary as AxesLibrary
    from metalens.pillars.axes.record import check as check
    from metalens.pillars.axes.record import load as load
    from metalens.pillars.axes.record import save as save
    from metalens.pillars.axes.record import sized as sized
    from metalens.pillars.axes.solving import sweep as sweep

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "AxesLibrary": "record",
        "KIND": "record",
        "check": "record",
        "figure": "plots",
        "load": "record",
        "save": "record",
        "sized": "record",
        "surface": "between",
        "sweep": "solving",
    },
)
