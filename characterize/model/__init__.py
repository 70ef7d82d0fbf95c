"""Parameters -> expected frames with derivatives."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from characterize.model import detector as detector
    from characterize.model import made as made
    from characterize.model import thinplate as thinplate
    from characterize.model.detector import oversampling as oversampling
    from characterize.model.forward import ForwardModel as ForwardModel
    from characterize.model.glass import Films as Films
    from characterize.model.glass import extra_path as extra_path
    from characterize.model.parameters import NAMES as NAMES
    from characterize.model.parameters import PARAMETERS as PARAMETERS
    from characterize.model.parameters import PLACE as PLACE
    from characterize.model.parameters import UNFITTED as UNFITTED
    from characterize.model.parameters import Known as Known
    from characterize.model.parameters import Parameter as Parameter
    from characterize.model.parameters import state as state
    from characterize.model.parameters import unfitted as unfitted
    from characterize.model.parameters import unstated as unstated
    from characterize.model.parameters import usual as usual
    from characterize.model.parameters import vector as vector
    from characterize.model.pillar_slopes import slopes as slopes
    from characterize.model.pillars import incidence_rad as incidence_rad
    from characterize.model.setting import LIGHT as LIGHT
    from characterize.model.setting import Setting as Setting
    from characterize.model.setting import Spectrum as Spectrum
    from characterize.model.setting import background as background
    from characterize.model.setting import light_maps as light_maps
    from characterize.model.setting import true_depth as true_depth
    from characterize.model.thinplate import MODES as MODES
    from characterize.model.thinplate import basis as basis
    from characterize.model.thinplate import prior_rad as prior_rad

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Films": "glass",
        "ForwardModel": "forward",
        "Known": "parameters",
        "LIGHT": "setting",
        "MODES": "thinplate",
        "NAMES": "parameters",
        "Parameter": "parameters",
        "PARAMETERS": "parameters",
        "PLACE": "parameters",
        "Setting": "setting",
        "Spectrum": "setting",
        "UNFITTED": "parameters",
        "background": "setting",
        "basis": "thinplate",
        "detector": "",
        "extra_path": "glass",
        "incidence_rad": "pillars",
        "light_maps": "setting",
        "made": "",
        "oversampling": "detector",
        "prior_rad": "thinplate",
        "slopes": "pillar_slopes",
        "state": "parameters",
        "thinplate": "",
        "true_depth": "setting",
        "unfitted": "parameters",
        "unstated": "parameters",
        "usual": "parameters",
        "vector": "parameters",
    },
)
