"""A lens: pillar diameters on a lattice with their cell and proxy."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.lens import picture as picture
    from metalens.lens.record import DiameterMap as DiameterMap
    from metalens.lens.record import Lens as Lens
    from metalens.lens.record import from_parts as from_parts
    from metalens.lens.record import load as load
    from metalens.lens.record import parts as parts
    from metalens.lens.record import save as save
    from metalens.lens.record import streamed as streamed

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "DiameterMap": "record",
        "Lens": "record",
        "from_parts": "record",
        "load": "record",
        "parts": "record",
        "picture": "",
        "save": "record",
        "streamed": "record",
    },
)
