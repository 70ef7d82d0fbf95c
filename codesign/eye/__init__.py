"""A parametric eye -> rendered frames with labels."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.eye import dataset as dataset
    from codesign.eye import landmarks as landmarks
    from codesign.eye import model as model
    from codesign.eye import population as population
    from codesign.eye import renderer as renderer
    from codesign.eye import textures as textures
    from codesign.eye.dataset import SeparabilityTriplets as SeparabilityTriplets
    from codesign.eye.dataset import ambiguity_pairs as ambiguity_pairs
    from codesign.eye.dataset import render_triplets as render_triplets
    from codesign.eye.dataset import states_at as states_at
    from codesign.eye.population import POPULATION as POPULATION
    from codesign.eye.population import CameraRig as CameraRig
    from codesign.eye.population import EyeStates as EyeStates
    from codesign.eye.population import MotionRanges as MotionRanges
    from codesign.eye.population import SubjectTrait as SubjectTrait
    from codesign.eye.population import mean_eye_um as mean_eye_um
    from codesign.eye.population import model_parameters as model_parameters
    from codesign.eye.renderer import FrameLabels as FrameLabels
    from codesign.eye.renderer import PinholeCamera as PinholeCamera
    from codesign.eye.renderer import RenderedFrames as RenderedFrames
    from codesign.eye.renderer import render as render
    from codesign.eye.view import CameraView as CameraView
    from codesign.eye.view import face_axes as face_axes
    from codesign.eye.worn import CAUSES as CAUSES
    from codesign.eye.worn import DrawnAugmentations as DrawnAugmentations
    from codesign.eye.worn import apply_augmentations as apply_augmentations
    from codesign.eye.worn import augment_irises as augment_irises
    from codesign.eye.worn import augmented_cameras as augmented_cameras
    from codesign.eye.worn import draw_augmentations as draw_augmentations
    from codesign.eye.worn import drawn_of_people as drawn_of_people
    from codesign.eye.worn import render_dressed as render_dressed

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CAUSES": "worn",
        "PinholeCamera": "renderer",
        "FrameLabels": "renderer",
        "MotionRanges": "population",
        "POPULATION": "population",
        "RenderedFrames": "renderer",
        "CameraRig": "population",
        "EyeStates": "population",
        "SubjectTrait": "population",
        "SeparabilityTriplets": "dataset",
        "ambiguity_pairs": "dataset",
        "dataset": "",
        "landmarks": "",
        "model": "",
        "apply_augmentations": "worn",
        "draw_augmentations": "worn",
        "drawn_of_people": "worn",
        "face_axes": "view",
        "mean_eye_um": "population",
        "model_parameters": "population",
        "population": "",
        "render": "renderer",
        "render_dressed": "worn",
        "renderer": "",
        "states_at": "dataset",
        "textures": "",
        "render_triplets": "dataset",
        "CameraView": "view",
        "DrawnAugmentations": "worn",
        "augment_irises": "worn",
        "augmented_cameras": "worn",
    },
)
