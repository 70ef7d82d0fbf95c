from . import report as report
from . import retrained_network as retrained_network
from . import source as source
from . import train as train
from .source import FinishedRun as FinishedRun
from .source import lens_file as lens_file
from .source import weights_file as weights_file
from .train import LensPsfs as LensPsfs
