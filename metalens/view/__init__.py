"""One self-contained page to explore an artefact: figures that can be turned, their
numbers beside them.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.view.artefacts import lens_panels as lens_panels
    from metalens.view.page import html as html
    from metalens.view.page import write as write
    from metalens.view.panels import Axis as Axis
    from metalens.view.panels import Classes as Classes
    from metalens.view.panels import Curves as Curves
    from metalens.view.panels import Drawing as Drawing
    from metalens.view.panels import Images as Images
    from metalens.view.panels import Numbers as Numbers
    from metalens.view.panels import Outline as Outline
    from metalens.view.panels import Panel as Panel
    from metalens.view.panels import Points as Points
    from metalens.view.panels import at_brightest as at_brightest

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Axis": "panels",
        "Classes": "panels",
        "Curves": "panels",
        "Drawing": "panels",
        "Images": "panels",
        "Numbers": "panels",
        "Outline": "panels",
        "Panel": "panels",
        "Points": "panels",
        "at_brightest": "panels",
        "html": "page",
        "lens_panels": "artefacts",
        "write": "page",
    },
)
