from . import report as report
from . import simple_lenses as simple_lenses
from .objective import DesignScore as DesignScore
from .objective import score_phase as score_phase
from .search import design_pupil as design_pupil
from .search import fisher_profile as fisher_profile
from .settings import FisherSettings as FisherSettings
from .settings import ResolvedFisherSettings as ResolvedFisherSettings
