"""One self-contained page to explore an artefact: figures that can be turned, their
numbers beside them.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.view.artefacts import lens_panels as lens_panels
    from metalens.view.page import page_html as page_html
    from metalens.view.page import write_page as write_page
    from metalens.view.panels import ClassMapPanel as ClassMapPanel
    from metalens.view.panels import CurvePanel as CurvePanel
    from metalens.view.panels import DrawingPanel as DrawingPanel
    from metalens.view.panels import ImagePanel as ImagePanel
    from metalens.view.panels import OutlinePanel as OutlinePanel
    from metalens.view.panels import Panel as Panel
    from metalens.view.panels import PointPanel as PointPanel
    from metalens.view.panels import SliderAxis as SliderAxis
    from metalens.view.panels import TablePanel as TablePanel
    from metalens.view.panels import at_brightest as at_brightest

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "SliderAxis": "panels",
        "ClassMapPanel": "panels",
        "CurvePanel": "panels",
        "DrawingPanel": "panels",
        "ImagePanel": "panels",
        "TablePanel": "panels",
        "OutlinePanel": "panels",
        "Panel": "panels",
        "PointPanel": "panels",
        "at_brightest": "panels",
        "page_html": "page",
        "lens_panels": "artefacts",
        "write_page": "page",
    },
)
