from . import bench as bench
from . import protocol as protocol
from .bench import HiddenLens as HiddenLens
from .bench import SimulatedFrames as SimulatedFrames
from .protocol import BenchProtocol as BenchProtocol
from .protocol import CapturePlan as CapturePlan
