"""A parametric eye -> rendered frames with labels."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.eye import dataset as dataset
    from codesign.eye import landmarks as landmarks
    from codesign.eye import model as model
    from codesign.eye import population as population
    from codesign.eye import renderer as renderer
    from codesign.eye import textures as textures
    from codesign.eye.dataset import Triplets as Triplets
    from codesign.eye.dataset import ambiguity_pairs as ambiguity_pairs
    from codesign.eye.dataset import states_at as states_at
    from codesign.eye.dataset import triplets as triplets
    from codesign.eye.population import POPULATION as POPULATION
    from codesign.eye.population import Motion as Motion
    from codesign.eye.population import Rig as Rig
    from codesign.eye.population import States as States
    from codesign.eye.population import Trait as Trait
    from codesign.eye.population import mean_eye_um as mean_eye_um
    from codesign.eye.population import parameters as parameters
    from codesign.eye.renderer import Camera as Camera
    from codesign.eye.renderer import Labels as Labels
    from codesign.eye.renderer import Rendered as Rendered
    from codesign.eye.renderer import render as render
    from codesign.eye.view import View as View
    from codesign.eye.view import face_axes as face_axes
    from codesign.eye.worn import CAUSES as CAUSES
    from codesign.eye.worn import Worn as Worn
    from codesign.eye.worn import drawn as drawn
    from codesign.eye.worn import drawn_of_people as drawn_of_people
    from codesign.eye.worn import dressed as dressed
    from codesign.eye.worn import pigmented as pigmented
    from codesign.eye.worn import render_dressed as render_dressed
    from codesign.eye.worn import viewed as viewed

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "CAUSES": "worn",
        "Camera": "renderer",
        "Labels": "renderer",
        "Motion": "population",
        "POPULATION": "population",
        "Rendered": "renderer",
        "Rig": "population",
        "States": "population",
        "Trait": "population",
        "Triplets": "dataset",
        "ambiguity_pairs": "dataset",
        "dataset": "",
        "landmarks": "",
        "model": "",
        "dressed": "worn",
        "drawn": "worn",
        "drawn_of_people": "worn",
        "face_axes": "view",
        "mean_eye_um": "population",
        "parameters": "population",
        "population": "",
        "render": "renderer",
        "render_dressed": "worn",
        "renderer": "",
        "states_at": "dataset",
        "textures": "",
        "triplets": "dataset",
        "View": "view",
        "Worn": "worn",
        "pigmented": "worn",
        "viewed": "worn",
    },
)
