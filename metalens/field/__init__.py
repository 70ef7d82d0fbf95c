"""The true image: PSFs that vary over field, depth and spectrum, through the films
around the lens.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.field.engine import imager as imager
    from metalens.field.engine import node_psfs as node_psfs
    from metalens.field.engine import normalised as normalised
    from metalens.field.engine import textured_frames as textured_frames
    from metalens.field.forming import Imager as Imager
    from metalens.field.forming import image_direct as image_direct
    from metalens.field.forming import with_psfs as with_psfs
    from metalens.field.plan import Grid as Grid
    from metalens.field.plan import Plan as Plan
    from metalens.field.points import Optics as Optics
    from metalens.field.points import Window as Window
    from metalens.field.points import psfs as psfs
    from metalens.field.slopes import drawn as drawn
    from metalens.field.slopes import node_light as node_light
    from metalens.field.slopes import surrogate as surrogate
    from metalens.field.slopes import term as term
    from metalens.field.waves import PillarWave as PillarWave
    from metalens.field.waves import SmoothWave as SmoothWave
    from metalens.field.waves import Wave as Wave
    from metalens.field.waves import cell_um as cell_um
    from metalens.lens import Layers as Layers

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Grid": "plan",
        "Imager": "forming",
        "Layers": "metalens.lens",
        "Optics": "points",
        "PillarWave": "waves",
        "Plan": "plan",
        "SmoothWave": "waves",
        "Wave": "waves",
        "Window": "points",
        "cell_um": "waves",
        "drawn": "slopes",
        "image_direct": "forming",
        "imager": "engine",
        "node_light": "slopes",
        "node_psfs": "engine",
        "normalised": "engine",
        "psfs": "points",
        "surrogate": "slopes",
        "term": "slopes",
        "textured_frames": "engine",
        "with_psfs": "forming",
    },
)
