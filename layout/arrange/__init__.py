"""Several lenses and cells on a die, dies on a wafer."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.arrange import apart as apart
    from layout.arrange import job_file as job_file
    from layout.arrange import joined as joined
    from layout.arrange import parts as parts
    from layout.arrange import seen as seen
    from layout.arrange import wafer as wafer
    from layout.arrange.record import Arrangement as Arrangement
    from layout.arrange.record import At as At
    from layout.arrange.record import CellPart as CellPart
    from layout.arrange.record import Furniture as Furniture
    from layout.arrange.record import LensPart as LensPart
    from layout.arrange.record import Wafer as Wafer

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Arrangement": "record",
        "At": "record",
        "CellPart": "record",
        "Furniture": "record",
        "LensPart": "record",
        "Wafer": "record",
        "apart": "",
        "job_file": "",
        "joined": "",
        "parts": "",
        "seen": "",
        "wafer": "",
    },
)
