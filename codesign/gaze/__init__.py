"""Pupil + slip -> gaze; personal calibration."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.gaze import bench as bench
    from codesign.gaze import people_file as people_file
    from codesign.gaze import personal as personal
    from codesign.gaze import shared as shared
    from codesign.gaze.bench import GazeErrors as GazeErrors
    from codesign.gaze.personal import PersonalGaze as PersonalGaze
    from codesign.gaze.personal import SphereCalibrator as SphereCalibrator
    from codesign.gaze.personal import angle_deg as angle_deg
    from codesign.gaze.readings import CalibratedPerson as CalibratedPerson
    from codesign.gaze.readings import NetworkReadings as NetworkReadings
    from codesign.gaze.readings import PersonCalibrator as PersonCalibrator
    from codesign.gaze.readings import face_angles as face_angles
    from codesign.gaze.shared import MixedModelPerson as MixedModelPerson
    from codesign.gaze.shared import PopulationPrior as PopulationPrior

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "PersonCalibrator": "readings",
        "GazeErrors": "bench",
        "MixedModelPerson": "shared",
        "PopulationPrior": "shared",
        "CalibratedPerson": "readings",
        "PersonalGaze": "personal",
        "NetworkReadings": "readings",
        "SphereCalibrator": "personal",
        "angle_deg": "personal",
        "bench": "",
        "face_angles": "readings",
        "people_file": "",
        "personal": "",
        "shared": "",
    },
)
