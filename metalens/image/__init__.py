"""Image formation: PSFs that vary over field, depth and spectrum; scenes, sensors, and
the Fisher information of images.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.image import pupil as pupil
    from metalens.image import scene as scene
    from metalens.image import sensor as sensor
    from metalens.image.engine import imager as imager
    from metalens.image.engine import node_psfs as node_psfs
    from metalens.image.engine import normalised as normalised
    from metalens.image.engine import textured_frames as textured_frames
    from metalens.image.forming import Imager as Imager
    from metalens.image.forming import image_direct as image_direct
    from metalens.image.forming import with_psfs as with_psfs
    from metalens.image.information import Normalisation as Normalisation
    from metalens.image.information import OpticsLoss as OpticsLoss
    from metalens.image.information import axial_information as axial_information
    from metalens.image.information import encircled_energy as encircled_energy
    from metalens.image.information import optics_loss as optics_loss
    from metalens.image.information import pixel_information as pixel_information
    from metalens.image.information import texture_information as texture_information
    from metalens.image.plan import Grid as Grid
    from metalens.image.plan import Plan as Plan
    from metalens.image.points import Optics as Optics
    from metalens.image.points import Window as Window
    from metalens.image.points import psfs as psfs
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
    from metalens.image.sensor import low_snr as low_snr
    from metalens.image.slopes import drawn as drawn
    from metalens.image.slopes import node_light as node_light
    from metalens.image.slopes import surrogate as surrogate
    from metalens.image.slopes import term as term
    from metalens.image.waves import PillarWave as PillarWave
    from metalens.image.waves import SmoothWave as SmoothWave
    from metalens.image.waves import Wave as Wave
    from metalens.image.waves import cell_um as cell_um

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CODES": "scene",
        "Field": "pupil",
        "Frames": "scene",
        "Grid": "plan",
        "Imager": "forming",
        "Normalisation": "information",
        "Optics": "points",
        "OpticsLoss": "information",
        "PillarWave": "waves",
        "Plan": "plan",
        "PsfBasis": "scene",
        "Pupil": "pupil",
        "Seen": "pupil",
        "Sensor": "sensor",
        "SmoothWave": "waves",
        "UniformImager": "scene",
        "Wave": "waves",
        "Window": "points",
        "amplitude": "pupil",
        "aperture_light": "pupil",
        "axial_information": "information",
        "basis": "scene",
        "cell_um": "waves",
        "coordinates": "pupil",
        "drawn": "slopes",
        "encircled_energy": "information",
        "image": "scene",
        "image_direct": "forming",
        "imager": "engine",
        "low_snr": "sensor",
        "node_light": "slopes",
        "node_psfs": "engine",
        "normalised": "engine",
        "optics_loss": "information",
        "pixel_information": "information",
        "psfs": "points",
        "pupil": "",
        "radius": "pupil",
        "scene": "",
        "sensor": "",
        "surrogate": "slopes",
        "term": "slopes",
        "texture_information": "information",
        "textured_frames": "engine",
        "uniform_imager": "scene",
        "view": "pupil",
        "weight_maps": "scene",
        "with_psfs": "forming",
    },
)
