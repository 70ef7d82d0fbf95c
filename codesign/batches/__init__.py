"""Frames as training takes them, over processes."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.batches import parallel as parallel
    from codesign.batches.batch import EyePose as EyePose
    from codesign.batches.batch import FrameBatch as FrameBatch
    from codesign.batches.batch import SceneSource as SceneSource
    from codesign.batches.flat import SingleSurfaceFrames as SingleSurfaceFrames
    from codesign.batches.flat import depth_um as depth_um
    from codesign.batches.flat import frame_samples as frame_samples
    from codesign.batches.flat import sensor_irradiance as sensor_irradiance
    from codesign.batches.pool import FramePool as FramePool
    from codesign.batches.pool import PoolScenes as PoolScenes
    from codesign.batches.pool import render_pool as render_pool
    from codesign.batches.scenes import CALIBRATION as CALIBRATION
    from codesign.batches.scenes import EXPERIMENT as EXPERIMENT
    from codesign.batches.scenes import TEST as TEST
    from codesign.batches.scenes import VALIDATION as VALIDATION
    from codesign.batches.scenes import EyeScenes as EyeScenes
    from codesign.batches.scenes import SceneConfig as SceneConfig
    from codesign.batches.scenes import as_batch as as_batch
    from codesign.batches.scenes import augmented_frames as augmented_frames
    from codesign.batches.scenes import draw_depth_scales as draw_depth_scales
    from codesign.batches.scenes import widen_motion as widen_motion

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "FrameBatch": "batch",
        "CALIBRATION": "scenes",
        "EXPERIMENT": "scenes",
        "EyeScenes": "scenes",
        "SingleSurfaceFrames": "flat",
        "FramePool": "pool",
        "PoolScenes": "pool",
        "EyePose": "batch",
        "SceneConfig": "scenes",
        "SceneSource": "batch",
        "TEST": "scenes",
        "VALIDATION": "scenes",
        "as_batch": "scenes",
        "draw_depth_scales": "scenes",
        "depth_um": "flat",
        "render_pool": "pool",
        "sensor_irradiance": "flat",
        "parallel": "",
        "frame_samples": "flat",
        "widen_motion": "scenes",
        "augmented_frames": "scenes",
    },
)
