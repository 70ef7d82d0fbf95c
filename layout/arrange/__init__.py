"""Several lenses and cells on a die, dies on a wafer."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.arrange import apart as apart
    from layout.arrange import job_file as job_file
    from layout.arrange import joined as joined
    from layout.arrange import parts as parts
    from layout.arrange import seen as seen
    from layout.arrange import wafer as wafer
    from layout.arrange.record import CellPart as CellPart
    from layout.arrange.record import Floorplan as Floorplan
    from layout.arrange.record import FrameSettings as FrameSettings
    from layout.arrange.record import LensPart as LensPart
    from layout.arrange.record import Placement as Placement
    from layout.arrange.record import WaferSettings as WaferSettings

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Floorplan": "record",
        "Placement": "record",
        "CellPart": "record",
        "FrameSettings": "record",
        "LensPart": "record",
        "WaferSettings": "record",
        "apart": "",
        "job_file": "",
        "joined": "",
        "parts": "",
        "seen": "",
        "wafer": "",
    },
)
