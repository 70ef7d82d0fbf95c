"""Libraries over two sizes: the width and the length of a rectangle, or both axes of an
ellipse.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.library.axes.between import interpolate_table as interpolate_table
    from metalens.library.axes.plots import axes_library_figure as axes_library_figure
    from metalens.library.axes.record import KIND as KIND
    from metalens.library.axes.record import AxesLibrary as AxesLibrary
    from metalens.library.axes.record import cell_of_sizes as cell_of_sizes
    from metalens.library.axes.record import check_axes_sweep as check_axes_sweep
    from metalens.library.axes.record import load as load
    from metalens.library.axes.record import save as save
    from metalens.library.axes.solving import sweep_two_sizes as sweep_two_sizes

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "AxesLibrary": "record",
        "KIND": "record",
        "check_axes_sweep": "record",
        "axes_library_figure": "plots",
        "load": "record",
        "save": "record",
        "cell_of_sizes": "record",
        "interpolate_table": "between",
        "sweep_two_sizes": "solving",
    },
)
