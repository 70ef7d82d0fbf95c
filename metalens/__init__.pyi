__version__: str

from . import cell as cell
from . import design as design
from . import fisher as fisher
from . import image as image
from . import lens as lens
from . import library as library
from . import materials as materials
from . import modal as modal
from . import propagate as propagate
from . import proxy as proxy
from . import psf as psf
from . import rcwa as rcwa
