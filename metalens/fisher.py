"""What images tell of a state: Fisher information (paper Eqs. 4-6, 11)."""

from metalens.image.information import Normalisation as Normalisation
from metalens.image.information import OpticsLoss as OpticsLoss
from metalens.image.information import axial_information as axial_information
from metalens.image.information import cramer_rao as cramer_rao
from metalens.image.information import encircled_energy as encircled_energy
from metalens.image.information import information as information
from metalens.image.information import optics_loss as optics_loss
from metalens.image.information import pixel_information as pixel_information
from metalens.image.information import texture_information as texture_information
