from . import module_view as module_view
from . import stages as stages
from .stages import ChainFiles as ChainFiles
from .stages import ChainStage as ChainStage
