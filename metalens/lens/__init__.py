"""A lens: pillar diameters on a lattice with their cell, their proxy, and the films
around them.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.lens import answers as answers
    from metalens.lens import export as export
    from metalens.lens import media as media
    from metalens.lens import picture as picture
    from metalens.lens import reach as reach
    from metalens.lens import smooth as smooth
    from metalens.lens.diameters import DiameterMap as DiameterMap
    from metalens.lens.layers import Layers as Layers
    from metalens.lens.layers import check_gaps as check_gaps
    from metalens.lens.media import Media as Media
    from metalens.lens.neighbours import CURVED as CURVED
    from metalens.lens.neighbours import NeighbourRows as NeighbourRows
    from metalens.lens.pairs import TwoSizeTable as TwoSizeTable
    from metalens.lens.record import HANDS as HANDS
    from metalens.lens.record import Hand as Hand
    from metalens.lens.record import Lens as Lens
    from metalens.lens.record import lens_from_parts as lens_from_parts
    from metalens.lens.record import lens_to_parts as lens_to_parts
    from metalens.lens.record import load as load
    from metalens.lens.record import load_out_of_core as load_out_of_core
    from metalens.lens.record import load_plain as load_plain
    from metalens.lens.record import save as save
    from metalens.lens.stop import Stop as Stop
    from metalens.lens.waves import saddle_correction as saddle_correction

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CURVED": "neighbours",
        "DiameterMap": "diameters",
        "HANDS": "record",
        "Hand": "record",
        "Layers": "layers",
        "Lens": "record",
        "Media": "media",
        "NeighbourRows": "neighbours",
        "TwoSizeTable": "pairs",
        "Stop": "stop",
        "answers": "",
        "check_gaps": "layers",
        "export": "",
        "lens_from_parts": "record",
        "load": "record",
        "load_plain": "record",
        "media": "",
        "lens_to_parts": "record",
        "picture": "",
        "reach": "",
        "saddle_correction": "waves",
        "save": "record",
        "smooth": "",
        "load_out_of_core": "record",
    },
)
