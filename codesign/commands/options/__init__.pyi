from . import budget as budget
from . import codesign as codesign
from . import experiment as experiment
from . import lens_report as lens_report
from . import optics as optics
from . import paper as paper
from . import retrain as retrain
from . import scene as scene
