"""Scene through PSFs onto the sensor, and what the image tells (quick pupil, Fisher
information).
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.field.engine import imager as imager
    from metalens.field.forming import Imager as Imager
    from metalens.field.plan import Grid as Grid
    from metalens.image import pupil as pupil
    from metalens.image import scene as scene
    from metalens.image import sensor as sensor
    from metalens.image.information import Normalisation as Normalisation
    from metalens.image.information import OpticsLoss as OpticsLoss
    from metalens.image.information import axial_information as axial_information
    from metalens.image.information import encircled_energy as encircled_energy
    from metalens.image.information import optics_loss as optics_loss
    from metalens.image.information import pixel_information as pixel_information
    from metalens.image.information import texture_information as texture_information
    from metalens.image.pupil import Field as Field
    from metalens.image.pupil import Pupil as Pupil
    from metalens.image.pupil import Seen as Seen
    from metalens.image.pupil import amplitude as amplitude
    from metalens.image.pupil import aperture_light as aperture_light
    from metalens.image.pupil import coordinates as coordinates
    from metalens.image.pupil import radius as radius
    from metalens.image.pupil import view as view
    from metalens.image.scene import CODES as CODES
    from metalens.image.scene import Frames as Frames
    from metalens.image.scene import PsfBasis as PsfBasis
    from metalens.image.scene import UniformImager as UniformImager
    from metalens.image.scene import basis as basis
    from metalens.image.scene import image as image
    from metalens.image.scene import uniform_imager as uniform_imager
    from metalens.image.scene import weight_maps as weight_maps
    from metalens.image.sensor import Sensor as Sensor
    from metalens.image.sensor import integrate as integrate
    from metalens.image.sensor import low_snr as low_snr
    from metalens.image.sensor import pixel_weights as pixel_weights

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CODES": "scene",
        "Field": "pupil",
        "Frames": "scene",
        "Grid": "metalens.field.plan",
        "Imager": "metalens.field.forming",
        "Normalisation": "information",
        "OpticsLoss": "information",
        "PsfBasis": "scene",
        "Pupil": "pupil",
        "Seen": "pupil",
        "Sensor": "sensor",
        "UniformImager": "scene",
        "amplitude": "pupil",
        "aperture_light": "pupil",
        "axial_information": "information",
        "basis": "scene",
        "coordinates": "pupil",
        "encircled_energy": "information",
        "image": "scene",
        "imager": "metalens.field.engine",
        "integrate": "sensor",
        "low_snr": "sensor",
        "optics_loss": "information",
        "pixel_information": "information",
        "pixel_weights": "sensor",
        "pupil": "",
        "radius": "pupil",
        "scene": "",
        "sensor": "",
        "texture_information": "information",
        "uniform_imager": "scene",
        "view": "pupil",
        "weight_maps": "scene",
    },
)
