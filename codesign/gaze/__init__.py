"""Pupil + slip -> gaze; personal calibration."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.gaze import bench as bench
    from codesign.gaze import people_file as people_file
    from codesign.gaze import personal as personal
    from codesign.gaze import shared as shared
    from codesign.gaze.bench import GazeErrors as GazeErrors
    from codesign.gaze.personal import PersonalGaze as PersonalGaze
    from codesign.gaze.personal import Sphere as Sphere
    from codesign.gaze.personal import angle_deg as angle_deg
    from codesign.gaze.readings import Calibrator as Calibrator
    from codesign.gaze.readings import Person as Person
    from codesign.gaze.readings import Readings as Readings
    from codesign.gaze.readings import face_angles as face_angles
    from codesign.gaze.shared import Own as Own
    from codesign.gaze.shared import People as People

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Calibrator": "readings",
        "GazeErrors": "bench",
        "Own": "shared",
        "People": "shared",
        "Person": "readings",
        "PersonalGaze": "personal",
        "Readings": "readings",
        "Sphere": "personal",
        "angle_deg": "personal",
        "bench": "",
        "face_angles": "readings",
        "people_file": "",
        "personal": "",
        "shared": "",
    },
)
