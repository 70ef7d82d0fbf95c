"""Parameters -> expected frames with derivatives."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.model import detector as detector
    from characterize.model import made as made
    from characterize.model import thinplate as thinplate
    from characterize.model.detector import (
        required_oversampling as required_oversampling,
    )
    from characterize.model.forward import ForwardModel as ForwardModel
    from characterize.model.glass import FilmStack as FilmStack
    from characterize.model.glass import extra_path as extra_path
    from characterize.model.parameters import NAMES as NAMES
    from characterize.model.parameters import PARAMETERS as PARAMETERS
    from characterize.model.parameters import PLACE as PLACE
    from characterize.model.parameters import UNFITTED as UNFITTED
    from characterize.model.parameters import FitParameter as FitParameter
    from characterize.model.parameters import KnownValue as KnownValue
    from characterize.model.parameters import parameter_vector as parameter_vector
    from characterize.model.parameters import process_state_of as process_state_of
    from characterize.model.parameters import type_b_sigma as type_b_sigma
    from characterize.model.parameters import unfitted_sizes as unfitted_sizes
    from characterize.model.parameters import usual_parameters as usual_parameters
    from characterize.model.pillar_slopes import (
        log_response_slopes as log_response_slopes,
    )
    from characterize.model.pillars import incidence_rad as incidence_rad
    from characterize.model.setting import LIGHT as LIGHT
    from characterize.model.setting import FrameSetting as FrameSetting
    from characterize.model.setting import SpectralLine as SpectralLine
    from characterize.model.setting import background_planes as background_planes
    from characterize.model.setting import light_maps as light_maps
    from characterize.model.setting import true_depth as true_depth
    from characterize.model.thinplate import MODES as MODES
    from characterize.model.thinplate import prior_rad as prior_rad
    from characterize.model.thinplate import thin_plate_basis as thin_plate_basis

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "FilmStack": "glass",
        "ForwardModel": "forward",
        "KnownValue": "parameters",
        "LIGHT": "setting",
        "MODES": "thinplate",
        "NAMES": "parameters",
        "FitParameter": "parameters",
        "PARAMETERS": "parameters",
        "PLACE": "parameters",
        "FrameSetting": "setting",
        "SpectralLine": "setting",
        "UNFITTED": "parameters",
        "background_planes": "setting",
        "thin_plate_basis": "thinplate",
        "detector": "",
        "extra_path": "glass",
        "incidence_rad": "pillars",
        "light_maps": "setting",
        "made": "",
        "required_oversampling": "detector",
        "prior_rad": "thinplate",
        "log_response_slopes": "pillar_slopes",
        "process_state_of": "parameters",
        "thinplate": "",
        "true_depth": "setting",
        "unfitted_sizes": "parameters",
        "type_b_sigma": "parameters",
        "usual_parameters": "parameters",
        "parameter_vector": "parameters",
    },
)
