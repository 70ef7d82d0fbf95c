"""Pupil + slip -> gaze; personal calibration."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.gaze import bench as bench
    from codesign.gaze import personal as personal
    from codesign.gaze.bench import GazeErrors as GazeErrors
    from codesign.gaze.personal import PersonalGaze as PersonalGaze
    from codesign.gaze.personal import angle_deg as angle_deg

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "GazeErrors": "bench",
        "PersonalGaze": "personal",
        "angle_deg": "personal",
        "bench": "",
        "personal": "",
    },
)
