"""Where each parameter of a frame sits in its row: ``model.AXIS`` is the first of three
columns, ``model.PUPIL_D`` one.
"""

import torch

from codesign.eye import kernel, population
from codesign.eye.renderer import PinholeCamera

LED, LED_COUNT = 24, 3
COUNT = kernel.COUNT
_PLACE = {name: 3 * k for k, name in enumerate(kernel.VECTORS)} | {
    name: 3 * len(kernel.VECTORS) + k for k, name in enumerate(kernel.NUMBERS)
}


def __getattr__(name):
    try:
        return _PLACE[name.lower()]
    except KeyError:
        raise AttributeError(name) from None


def rows(states, rig, pixel_rad):
    """(n, COUNT) parameters of frames, float64, differentiable."""
    p = population.model_parameters(states, rig, pixel_rad=pixel_rad)
    columns = [p[name] for name in kernel.VECTORS + kernel.NUMBERS]
    return torch.cat([c.reshape(len(c), -1) for c in columns], 1)


def rows_of_camera(states, rig, camera: PinholeCamera):
    """The same for the pixels of a camera."""
    return rows(states, rig, camera.pitch_um / rig.sensor_distance_um)
