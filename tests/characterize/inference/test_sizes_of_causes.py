"""Causes that a fit leaves out: what each does to images linear in everything, and how
much of it is likely.
"""

import re
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import causes
from characterize.model import (
    MODES,
    PLACE,
    FrameSetting,
    KnownValue,
    parameter_vector,
    prior_rad,
    type_b_sigma,
)
from metalens.fabrication import WavefrontError, named
from metalens.lens import Lens

SHAPE = (4, 5, 7)
RNG = np.random.default_rng(41)
SLOPES = RNG.normal(size=(len(PLACE), *SHAPE))
LIGHT, LEANING, MOVED = (
    RNG.uniform(3, 9, SHAPE),
    RNG.normal(size=SHAPE),
    RNG.normal(size=(MODES + 3, *SHAPE)),
)
LENS = b.row(
    300.0,
    wavelength_um=0.83,
    sensor_distance_um=1170.0,
    layers=b.GLASS,
    source_distance_um=5200.0,
)


@dataclass
class Sensor:
    pixel_um: float = 3.0
    rows: int = 5
    columns: int = 7
    margin: int = 4
    fill: float = 1.0
    oversample: int = 2
    edges = FrameSetting.edges
    glow: float = 1.0


@dataclass
class Model:
    """Images that are linear in parameters, in the wall's angle, in smooth phases and
    in the pixel.
    """

    wall_rad: float = 0.0
    moved: tuple[float, ...] = ()
    setting: Sensor = field(default_factory=Sensor)
    grid: Sensor = field(default_factory=Sensor)
    lens: Lens = field(default_factory=lambda: LENS)
    modes: tuple[int, ...] = ()
    groups: tuple[SimpleNamespace, ...] = ()
    cut: float = 0.0

    def images(self, x, names=()):
        light = LIGHT + np.tensordot(x, SLOPES, 1) + self.wall_rad * LEANING
        light = light + np.tensordot(np.array(self.moved), MOVED[: len(self.moved)], 1)
        slopes = [
            MOVED[int(n[9:])] if n.startswith("residual_") else SLOPES[PLACE[n]]
            for n in names
        ]
        close = self.setting.rows // SHAPE[1]  # samples a pixel's side, all alike
        pitch_um = self.setting.pixel_um * close
        light = (
            light
            * (1 + 5 * (pitch_um / 3 - 1))
            * self.grid.pixel_um
            / self.setting.pixel_um
        )
        return light.repeat(close, 1).repeat(close, 2), slopes

    def rough(self, cut):
        return self

    def with_walls(self, rad):
        return replace(self, wall_rad=rad)

    def with_residual(self, amounts, shape):
        return replace(self, moved=tuple(amounts))


@dataclass
class Asked:
    model: Model
    names: tuple[str, ...]
    known: dict
    unfitted: dict


def found(names=("bias_nm",), known=None, unfitted=None):
    x = parameter_vector({"bias_nm": 2.0, "background_e": 1.5, "index": 0.004})
    task = Asked(Model(), names, known or {}, unfitted or {})
    image = task.model.images(x)[0]
    slopes = {
        name: SLOPES[PLACE[name]] for name in ("stage_zero_um", *named(WavefrontError))
    }
    return {one.cause: one for one in causes.systematic_changes(task, x, slopes)}, image


def test_a_stated_wall_is_reckoned_with_by_the_mean_square_of_its_angle():
    """1.2 degrees with a sigma of 0.5: 1.3 about none; an index is as uncertain as it
    is stated, whatever it is.
    """
    stated = {
        "sidewall_deg": KnownValue("sidewall_deg", 1.2, 0.5),
        "index": KnownValue("index", 0.03, 0.004),
    }
    every, _ = found(known=stated)
    assert every["a tilted side wall"].sigma == pytest.approx(1.3 / 0.5)
    assert every["a side wall that leans about half height"].sigma == pytest.approx(
        (1.3 / 1.5) ** 2
    )
    assert every["another refractive index"].sigma == pytest.approx(0.004 / 0.01)


@pytest.mark.parametrize(
    ("unfitted", "sigma"), [({}, 0.3), ({"window_px": 0.07}, 0.07)]
)
def test_windows_of_every_angle_but_the_first_move_alone(unfitted, sigma):
    """Frames 0 and 2 at the first angle, 1 and 3 at two more: by a pixel of 3 um along
    x, then y.
    """
    x, every = (
        parameter_vector(),
        {
            name: SLOPES[PLACE[name]]
            for name in ("decentre_x_um", "decentre_y_um", "stage_zero_um")
        },
    )
    groups = tuple(
        SimpleNamespace(index=np.array(index)) for index in ([0, 2], [1], [3])
    )
    task = Asked(Model(groups=groups), ("bias_nm",), {}, unfitted)
    every |= {name: SLOPES[PLACE[name]] for name in named(WavefrontError)}
    (found,) = [
        one
        for one in causes.systematic_changes(task, x, every)
        if one.cause == causes.WINDOWS
    ]
    want = np.zeros((4, *SHAPE))
    for k, (frame, name) in enumerate(
        (f, n) for f in (1, 3) for n in ("decentre_x_um", "decentre_y_um")
    ):
        want[k, frame] = 3.0 * SLOPES[PLACE[name], frame]
    assert found.images == pytest.approx(want)
    assert found.sigma == pytest.approx(sigma)
    one = replace(task, model=Model(groups=groups[:1]))
    assert causes.WINDOWS not in [
        cause.cause for cause in causes.systematic_changes(one, x, every)
    ]


def test_write_fields_are_as_far_out_of_place_as_stated_and_smooth_phases_as_their_prior():
    """32 fields, 1 um each: 60 nm where nobody says, what is stated in nm."""
    for unfitted, sigma in ({}, 0.06), ({"stitching_nm": 11.0}, 0.011):
        every, _ = found(unfitted=unfitted)
        fields = every["write fields out of place"]
        assert fields.images.shape == (32, *SHAPE)
        assert fields.sigma == pytest.approx(sigma)
        assert fields.roughly
        assert not fields.sought
    shapes = np.concatenate([MOVED, SLOPES[[PLACE[n] for n in named(WavefrontError)]]])
    assert fields.images == pytest.approx(
        np.tensordot(causes.write_fields(LENS), shapes, 1), abs=1e-9
    )
    smooth = every["a smooth phase that no parameter describes"]
    assert smooth.images == pytest.approx(
        MOVED[:MODES] * prior_rad()[:, None, None, None]
    )
    half = every["a write field off along y"]
    assert half.images == pytest.approx(0.05 * MOVED[None, 0])
    assert half.amount == pytest.approx(50.0)


def test_what_is_fitted_or_stated_exactly_is_no_cause():
    every, _ = found(
        names=("bias_nm", "tilt_x_deg", "glass_um", "light_x", "light_y", "light_r")
    )
    assert "a tilt of the lens about y" not in every
    assert "a plate of glass in the beam" not in every
    assert "uneven illumination" not in every
    none, _ = found(known={"glass_um": KnownValue("glass_um", 0.0)})
    assert not [cause for cause in none if "of glass about" in cause]
    assert (
        none["a plate of glass in the beam"].frees == ()
    )  # looked for by name, and kept as it is stated
    some, _ = found(
        known={
            "glass_um": KnownValue("glass_um", 90.0, 5.0),
            "light_y": KnownValue("light_y", 0.0),
        }
    )
    assert some["a plate of glass in the beam"].frees == ("glass_um",)
    assert some["uneven illumination"].frees == ("light_x", "light_r")


def test_counts_of_a_gamma_differ_from_the_light_as_their_logarithm():
    """Light from 2 to 100 % of its peak to powers 1.0001 and 0.9999: their difference."""
    light = RNG.uniform(0.02, 1.0, SHAPE) * 730.0
    share = light / light.max()
    assert causes._of_gamma(light)[0] == pytest.approx(
        (share**1.0001 - share**0.9999) / 2e-4, abs=1e-6
    )


def test_the_page_says_the_sizes_that_are_reckoned_with():
    """Numbers of the row on spectrum, tilt, index and saddles, and of others that are
    of one parameter each.
    """
    page = (Path(__file__).parents[3] / "docs" / "characterize.md").read_text(
        encoding="utf-8"
    )

    def numbers(head):
        (row,) = (line for line in page.splitlines() if line.startswith(f"| {head} |"))
        return [float(n) for n in re.findall(r"[0-9.]*[0-9]", row.split("|")[2])]

    def sizes(*names):
        return [type_b_sigma(name, LENS) for name in names]

    four = sizes("bandwidth_nm", "tilt_x_deg", "index", "bias_a_nm")
    assert numbers(
        "spectrum, tilt of the lens, index, saddles of the bias"
    ) == pytest.approx(four)
    assert numbers("plane glass between source and lens") == sizes("glass_um")
    assert numbers("diameter of the source") == sizes("pinhole_um")
    assert numbers("pixel pitch") == sizes("pixel_percent")
    assert numbers("turn of the camera against the lens") == sizes("camera_turn_deg")
    assert numbers("write fields of the mask out of place") == sizes("stitching_nm")
    assert numbers("side wall")[0] == type_b_sigma("sidewall_deg", LENS)
