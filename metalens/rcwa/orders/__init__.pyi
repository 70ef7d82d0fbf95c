from . import basis as basis
from . import mirrors as mirrors
from . import waves as waves
