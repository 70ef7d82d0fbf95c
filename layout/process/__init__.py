"""What writer and etch can do (records only)."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.process import isolation as isolation
    from layout.process import names as names
    from layout.process import process as process
    from layout.process.jit import announce_compilation as announce_compilation
    from layout.process.jit import compile_loop as compile_loop
    from layout.process.process import DesignRules as DesignRules
    from layout.process.process import ExposureSettings as ExposureSettings
    from layout.process.process import KeepOutZone as KeepOutZone
    from layout.process.process import LayerNumber as LayerNumber
    from layout.process.process import Process as Process
    from layout.process.process import WriteField as WriteField

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "ExposureSettings": "process",
        "LayerNumber": "process",
        "Process": "process",
        "DesignRules": "process",
        "WriteField": "process",
        "KeepOutZone": "process",
        "compile_loop": "jit",
        "isolation": "",
        "names": "",
        "announce_compilation": "jit",
        "process": "",
    },
)
