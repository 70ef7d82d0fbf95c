from .fit import PupilFit as PupilFit
from .fit import fit_pupil as fit_pupil
from .fit import save_pupil as save_pupil
from .model import PupilModel as PupilModel
from .model import PupilSpec as PupilSpec
