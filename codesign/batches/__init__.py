"""Frames as training takes them, over processes."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.batches import parallel as parallel
    from codesign.batches.batch import Batch as Batch
    from codesign.batches.batch import Pose as Pose
    from codesign.batches.batch import Scenes as Scenes
    from codesign.batches.flat import Flat as Flat
    from codesign.batches.flat import depth_um as depth_um
    from codesign.batches.flat import irradiance as irradiance
    from codesign.batches.flat import samples as samples
    from codesign.batches.pool import Pool as Pool
    from codesign.batches.pool import PoolScenes as PoolScenes
    from codesign.batches.pool import fill as fill
    from codesign.batches.scenes import CALIBRATION as CALIBRATION
    from codesign.batches.scenes import EXPERIMENT as EXPERIMENT
    from codesign.batches.scenes import TEST as TEST
    from codesign.batches.scenes import VALIDATION as VALIDATION
    from codesign.batches.scenes import EyeScenes as EyeScenes
    from codesign.batches.scenes import SceneConfig as SceneConfig
    from codesign.batches.scenes import as_batch as as_batch
    from codesign.batches.scenes import decoupled as decoupled
    from codesign.batches.scenes import varied as varied
    from codesign.batches.scenes import worn as worn

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Batch": "batch",
        "CALIBRATION": "scenes",
        "EXPERIMENT": "scenes",
        "EyeScenes": "scenes",
        "Flat": "flat",
        "Pool": "pool",
        "PoolScenes": "pool",
        "Pose": "batch",
        "SceneConfig": "scenes",
        "Scenes": "batch",
        "TEST": "scenes",
        "VALIDATION": "scenes",
        "as_batch": "scenes",
        "decoupled": "scenes",
        "depth_um": "flat",
        "fill": "pool",
        "irradiance": "flat",
        "parallel": "",
        "samples": "flat",
        "varied": "scenes",
        "worn": "scenes",
    },
)
