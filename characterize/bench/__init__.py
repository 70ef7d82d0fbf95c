"""The virtual bench and which frames to take."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from characterize.bench import bench as bench
    from characterize.bench import protocol as protocol
    from characterize.bench.bench import Shots as Shots
    from characterize.bench.bench import Truth as Truth
    from characterize.bench.protocol import Plan as Plan
    from characterize.bench.protocol import Protocol as Protocol

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Plan": "protocol",
        "Protocol": "protocol",
        "Shots": "bench",
        "Truth": "bench",
        "bench": "",
        "protocol": "",
    },
)
