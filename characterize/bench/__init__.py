"""The virtual bench and which frames to take."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.bench import bench as bench
    from characterize.bench import protocol as protocol
    from characterize.bench.bench import HiddenLens as HiddenLens
    from characterize.bench.bench import SimulatedFrames as SimulatedFrames
    from characterize.bench.protocol import BenchProtocol as BenchProtocol
    from characterize.bench.protocol import CapturePlan as CapturePlan

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CapturePlan": "protocol",
        "BenchProtocol": "protocol",
        "SimulatedFrames": "bench",
        "HiddenLens": "bench",
        "bench": "",
        "protocol": "",
    },
)
