"""What writer and etch can do (records only)."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.process import isolation as isolation
    from layout.process import names as names
    from layout.process import process as process
    from layout.process.jit import compiled as compiled
    from layout.process.jit import noticed as noticed
    from layout.process.process import Exposure as Exposure
    from layout.process.process import LayerNumber as LayerNumber
    from layout.process.process import Process as Process
    from layout.process.process import Rules as Rules
    from layout.process.process import WriteField as WriteField
    from layout.process.process import Zone as Zone

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Exposure": "process",
        "LayerNumber": "process",
        "Process": "process",
        "Rules": "process",
        "WriteField": "process",
        "Zone": "process",
        "compiled": "jit",
        "isolation": "",
        "names": "",
        "noticed": "jit",
        "process": "",
    },
)
