from .search import DesignScore as DesignScore
from .search import design_pupil as design_pupil
from .search import fisher_profile as fisher_profile
from .search import score_phase as score_phase
from .settings import FisherSettings as FisherSettings
from .settings import ResolvedFisherSettings as ResolvedFisherSettings
