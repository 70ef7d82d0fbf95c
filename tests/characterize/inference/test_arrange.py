"""How frames lie, read off the frames."""

import dataclasses
import functools
import sys
import types
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.captures import orient_frames
from characterize.captures.electrons import to_electrons
from characterize.inference import arrange as arranging
from characterize.inference import estimate, search
from characterize.inference.prepare import data_of, setting_of
from characterize.inference.search import SearchTask
from characterize.model import parameter_vector
from characterize.model.forward import ForwardModel
from metalens import design, profiles
from metalens.cell import Cell


@pytest.mark.parametrize("side", [4, 6, 16])
def test_frames_in_order_stay_so_in_windows_that_the_light_fills(side):
    """Less a plane through their rim, such frames may sum to nothing or less; no number
    may grow beyond bounds.
    """
    shots = b.capture(b.electrons())
    middle = slice(8 - side // 2, 8 + side // 2)
    shots = dataclasses.replace(shots, frames=shots.frames[:, middle, middle])
    frames = to_electrons(shots)
    setting, window = setting_of(shots, 64)
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = arranging.find_arrangement(model, data_of(frames, window), scan_um=20.0)
    assert not found.reordered
    assert not found.clearly


@functools.lru_cache
def helix():
    """A double helix of 40 um: its image turns with depth, and half a turn changes it
    by a part in 2000.
    """
    focus = profiles.Focus(0.85, 110.0, 600.0)
    phase = design.phase_of(profiles.DoubleHelix(3), focus, radius_um=20.0)
    return design.make(
        phase, focus, aperture_um=40.0, cell=Cell(pitch_um=0.4), proxy=b.proxy()
    )[0]


def task_of(shots, lens):
    """What a fit begins with."""
    setting, window = setting_of(shots, 64)
    model, data = (
        ForwardModel(lens, setting, b.RESPONSE),
        data_of(to_electrons(shots), window),
    )
    return SearchTask(
        model,
        data,
        parameter_vector(),
        {},
        arranging.find_arrangement(model, data, scan_um=60.0),
    )


def laid(way, *, peak_e=6000.0):
    """How frames of a helix as made seem to lie whose camera lies some way, and how a
    fit takes them.
    """
    light = bench.bench_irradiance(helix(), b.truth(), b.RESPONSE)
    shots = b.capture(
        light * (peak_e / light.max()) + bench.background_plane(b.truth())
    )
    shots = dataclasses.replace(
        shots, frames=np.ascontiguousarray(orient_frames(shots.frames, way))
    )
    whole = task_of(shots, helix())
    found = whole.found
    return found, search.choose_orientation(
        [estimate._as_laid(whole, one) for one in (found, *found.others)]
    ).found


@pytest.mark.parametrize(
    ("way", "back"), [(0, 0), (2, 2), (3, 1), (4, 4), (6, 6), (7, 7)]
)
def test_half_a_turn_that_images_hardly_show_is_told_by_a_fit(way, back):
    """As made, images are alike to 0.956, turned by 180° to 0.953: the plainer of the
    two was taken.
    """
    seen, taken = laid(way)
    assert (taken.orientation, taken.clearly, taken.reordered, taken.alike) == (
        back,
        back != 0,
        False,
        (),
    )
    assert (
        abs(seen.stage_zero_um - b.VALUES["stage_zero_um"]) < 25
    )  # astigmatism moves the best focus by as much


def test_half_a_turn_that_noise_hides_is_said():
    _, taken = laid(0, peak_e=40.0)
    assert (taken.orientation, taken.alike) == (0, (2,))


@pytest.mark.parametrize(
    ("ends", "turned"),
    [((9000.0, 9500.0), False), ((9300.0, 9265.0), False), ((9300.0, 9250.0), True)],
)
def test_a_turn_is_taken_where_it_is_better_once_both_fits_have_gone_on(
    monkeypatch, ends, turned
):
    """Short fits put the turned frames 100 ahead; what counts is where both end, and 40
    between these.
    """
    shots = b.capture(b.electrons())
    plain = task_of(shots, b.lens())
    tasks = [
        plain,
        dataclasses.replace(
            plain, found=dataclasses.replace(plain.found, orientation=1, clearly=True)
        ),
    ]
    merit = {0: 9600.0, 1: 9500.0}
    shorts = [
        types.SimpleNamespace(value=np.full(1, float(k)), merit=merit[k]) for k in merit
    ]
    monkeypatch.setattr(
        search, "_short", lambda task, few, begins: [shorts[task.found.orientation]]
    )
    monkeypatch.setattr(search, "starting_points", lambda task, **_: [])

    def gone_on(images, data, begin, **_):
        return types.SimpleNamespace(merit=ends[int(begin[0])])

    monkeypatch.setattr(search.leastsquares, "fit_levenberg_marquardt", gone_on)
    assert search.choose_orientation(tasks).found.orientation == int(turned)
