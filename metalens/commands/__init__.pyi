from . import picture as picture
from .common import MASKS as MASKS
from .common import CommonOptions as CommonOptions
from .common import DistributedOptions as DistributedOptions
from .common import MaybeOutput as MaybeOutput
from .common import Output as Output
