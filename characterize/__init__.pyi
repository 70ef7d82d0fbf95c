from .captures.capture import Capture as Capture
from .captures.capture import load as load
from .inference.asbuilt import AsBuilt as AsBuilt
from .inference.estimate import fit as fit
from .pupil.fit import fit_pupil as fit_pupil
from .pupil.model import PupilSpec as PupilSpec
