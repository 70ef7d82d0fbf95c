"""Optimal design: against every possible choice, against evenly spread frames, and on
the command line.
"""

import dataclasses
import itertools
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import protocol
from characterize.bench.protocol import BenchProtocol, IntervalRequirement
from characterize.inference import missing
from characterize.model import UNFITTED
from metalens import lens as lenses
from metalens.cli import main
from metalens.core.errors import FitError

NAMES = ("bias_nm", "distance_um", "spherical_rad")
WANTED = BenchProtocol(
    (380.0, 1150.0),
    depth_count=6,
    frames=3,
    pixel_um=1.5,
    pixels=16,
    exposures=(0.5, 1.0),
)


@pytest.fixture(scope="module")
def candidates():
    random = np.random.default_rng(0)
    slopes = random.standard_normal((7, 3, 5)) * [[1.0], [0.5], [20.0]]
    return slopes @ slopes.transpose(0, 2, 1)


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_choice_is_the_best_of_all(candidates, criterion):
    prior = np.eye(3) * 1e-3

    def value(pick):
        return protocol.design_criterion(
            prior + candidates[list(pick)].sum(0), criterion, NAMES
        )

    found = protocol.choose_frames(
        candidates, prior, 3, criterion=criterion, names=NAMES
    )
    best = max(itertools.combinations_with_replacement(range(7), 3), key=value)
    assert value(found) > 0.98 * value(best)  # exchanges may end in a local optimum


@pytest.mark.parametrize("count", [3, 6])
def test_frames_lie_at_four_places_where_there_are_so_many(count):
    """One place tells ten times as much as each other: all frames would be there, but
    for the test of the model.
    """
    random = np.random.default_rng(3)
    slopes = random.standard_normal((8, 3, 5)) * [[1.0], [0.5], [20.0]]
    slopes[2:4] *= 3.3
    information, place = slopes @ slopes.transpose(0, 2, 1), np.arange(8) // 2
    prior, more = np.eye(3) * 1e-3, {"criterion": "A", "names": NAMES}
    assert set(place[protocol.choose_frames(information, prior, count, **more)]) == {1}
    found = protocol.choose_frames(information, prior, count, place=place, **more)
    assert len(found) == count
    assert len(set(place[found])) == min(count, 4)
    assert (place[found] == 1).sum() == count - min(count, 4) + 1
    two = protocol.choose_frames(information[:4], prior, count, place=place[:4], **more)
    assert set(place[two]) == {0, 1}  # there are no more


def test_plan_beats_frames_spread_evenly():
    found = protocol.plan_captures(b.lens(), WANTED, b.RESPONSE)
    scale = [protocol.PARAMETERS[protocol.PLACE[n]].scale for n in found.names]
    ours, even = (np.square(s / scale).sum() for s in (found.sigma, found.even_sigma))
    assert ours < even
    assert np.all(np.diff(found.gain) > -1e-9)
    assert set(found.exposure) <= {0.5, 1.0}


def test_frames_that_saturate_tell_less():
    _, dim = protocol.candidate_information(b.lens(), WANTED, b.RESPONSE, NAMES)
    bright = BenchProtocol(
        (380.0, 1150.0),
        depth_count=6,
        pixel_um=1.5,
        pixels=16,
        exposures=(40.0,),
        full_well_e=9000.0,
    )
    _, clipped = protocol.candidate_information(b.lens(), bright, b.RESPONSE, NAMES)
    full = BenchProtocol(
        (380.0, 1150.0),
        depth_count=6,
        pixel_um=1.5,
        pixels=16,
        exposures=(40.0,),
        full_well_e=1e9,
    )
    _, whole = protocol.candidate_information(b.lens(), full, b.RESPONSE, NAMES)
    assert (
        np.trace(clipped, axis1=1, axis2=2) < np.trace(whole, axis1=1, axis2=2)
    ).all()
    assert len(dim) == 2 * len(whole)


def test_protocol_on_the_command_line(tmp_path, capsys):
    lenses.save(tmp_path / "lens.h5", b.lens())
    (tmp_path / "p.toml").write_text(
        "depths_um = [380.0, 1150.0]\ndepth_count = 4\nframes = 2\npixel_um = 1.5\npixels = 16\n"
    )
    words = [
        "capture",
        str(tmp_path / "lens.h5"),
        "--protocol",
        str(tmp_path / "p.toml"),
    ]
    assert main([*words, "-o", str(tmp_path / "stage.csv"), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert len(values["frames"]) == 2
    assert values["sigma"]["bias_nm"] > 0
    assert any("in focus" in words for words in values["warnings"])  # 0.23 waves
    assert any("fewer than 4 cannot be tested" in words for words in values["warnings"])
    assert (
        values["untold_sigma"]["bias_nm"] > 0.5
    )  # glass, walls, write fields, that nobody stated
    lines = (tmp_path / "stage.csv").read_text().splitlines()
    assert lines[0] == "file,depth_um,angle_deg,relative_exposure"
    assert len(lines) == 3
    assert (
        main([*words, "--truth", str(tmp_path / "p.toml"), "-o", str(tmp_path / "x")])
        == 2
    )


def test_impossible_protocols_are_refused():
    with pytest.raises(FitError, match="nearest < farthest"):
        BenchProtocol((2.0, 1.0))


def test_no_more_frames_are_taken_than_the_wanted_intervals_need():
    """The bound of one measurement repeated: with ten like frames of sigma 1, four give
    0.5, 95 % within 0.98.
    """
    same = np.full((3, 1, 1), 1.0)
    prior, chosen = np.zeros((1, 1)), [0] * 10
    for within, frames in ((1.95997 / 2, 4), (1.95995 / 2, 5), (1.9, 2), (0.1, 10)):
        wanted = (IntervalRequirement("bias_nm", within),)
        assert (
            protocol._needed(same, prior, chosen, ("bias_nm",), wanted, least=1)
            == frames
        )
        assert protocol._needed(
            same, prior, chosen, ("bias_nm",), wanted, least=3
        ) == max(frames, 3)
    words = protocol._short(
        ("bias_nm",),
        np.array([0.5]),
        missing.UnmodelledShifts.none(1),
        (IntervalRequirement("bias_nm", 0.49),),
        4,
    )
    assert "4.0 times the light (16 such frames)" in words[0]


def test_what_cannot_be_told_is_part_of_a_wanted_interval():
    """Shifts of 0.36: 95 % within 0.707. What is wanted beyond that is left to the
    frames, root of 1 - 0.5 = 0.7.
    """
    stated = missing.UnmodelledShifts(
        ("a plate", "a wall"),
        np.array([[0.2], [0.3]]),
        np.array([[0.13]]),
        np.zeros((1, 1)),
    )
    (left,) = protocol._left(
        ("bias_nm",), stated.sigma, (IntervalRequirement("bias_nm", 1.0),)
    )
    assert left.within == pytest.approx(math.sqrt(1 - 1.959964**2 * 0.13), rel=1e-5)
    (over,) = protocol._left(
        ("bias_nm",), stated.sigma, (IntervalRequirement("bias_nm", 0.7),)
    )
    assert over.within == 0.7
    (words,) = protocol._short(
        ("bias_nm",), np.array([0.5]), stated, (IntervalRequirement("bias_nm", 0.7),), 4
    )
    assert (
        "known to +- 1.2, wanted +- 0.7: within the model it is +- 0.98, more frames do not help"
        in words
    )
    assert "first of all a wall, a plate" in words
    (words,) = protocol._short(
        ("bias_nm",), np.array([0.5]), stated, (IntervalRequirement("bias_nm", 1.0),), 4
    )
    assert "1.9 times the light (8 such frames)" in words  # 0.96 / 0.5006
    assert not protocol._short(
        ("bias_nm",),
        np.array([0.5]),
        stated,
        (IntervalRequirement("bias_nm", 1.22),),
        4,
    )


def test_a_plan_has_frames_enough_for_a_fit_that_tests_itself():
    """Four depths or angles; the same place again is none."""
    frames = np.array(
        [
            [5.0, 0.0, 1.0],
            [5.0, 0.0, 2.0],
            [6.0, 0.0, 1.0],
            [6.0, 3.0, 1.0],
            [5.0, 0.0, 1.0],
            [7.0, 0, 1],
        ]
    )
    assert protocol._least(frames) == 6
    assert protocol._least(frames[:4]) == 4
    assert protocol._few(frames) == []
    assert (
        "3 of the depths and angles: a fit of fewer than 4 cannot be tested"
        in protocol._few(frames[:4])[0]
    )
    assert "fewer than 2 is refused" in protocol._few(frames[:2])[0]


def test_a_plan_in_focus_or_on_one_side_of_it_is_warned_of():
    """R = 19.8 um, focus at 600 um: 196 um² (1 / 300 - 1 / 600) / 0.85 um = 0.38 waves,
    and 0.54 from 250 um.
    """
    lens, both = b.lens(), np.array([250.0, 1150.0])
    near = dataclasses.replace(WANTED, depths_um=(300.0, 1150.0))
    words = protocol._blind(lens, near, np.array([300.0, 1150.0]))[0]
    assert "0.38 waves" in words
    assert "fixes its bias" in words
    wide = dataclasses.replace(WANTED, depths_um=(250.0, 1150.0))
    assert not protocol._blind(lens, wide, both)
    assert (
        "nearer than the focus at 600 um"
        in protocol._blind(lens, wide, np.array([250.0, 590.0]))[0]
    )
    assert (
        "farther than the focus"
        in protocol._blind(lens, wide, np.array([610.0, 1100.0]))[0]
    )
    with pytest.raises(FitError, match="no such parameter"):
        IntervalRequirement("bias", 1.0)


def test_information_of_a_frame_is_its_slopes_over_its_noise(monkeypatch):
    """Light and slopes times the exposure, over photons and read noise; what reaches
    the full well says nothing.
    """
    random = np.random.default_rng(5)
    light = random.uniform(50, 900, (6, 4, 4))
    slopes = random.standard_normal((2, 6, 4, 4))
    scale = []

    class Straight:
        def __init__(self, lens, setting, response):
            assert setting.depth_um == pytest.approx(
                np.tile(1 / np.linspace(1 / 400, 1 / 900, 3), 2)
            )
            assert setting.angle_rad == pytest.approx(
                np.stack([np.repeat([0.0, np.radians(7)], 3), np.zeros(6)], 1)
            )

        def images(self, x, names=None):
            scale.append(x[protocol.PLACE["log_gain"]])
            return light, None if names is None else slopes

    monkeypatch.setattr(protocol, "ForwardModel", Straight)
    wanted = BenchProtocol(
        (400.0, 900.0),
        depth_count=3,
        angles_deg=(0.0, 7.0),
        exposures=(0.7, 1.6),
        full_well_e=1100.0,
        read_noise_e=3.3,
    )
    rows, found = protocol.candidate_information(
        None, wanted, None, ("bias_nm", "distance_um")
    )
    assert scale == [0.0, pytest.approx(np.log(8000.0 / light.max()))]
    assert rows[:, 2].tolist() == [0.7] * 6 + [1.6] * 6
    for place, (exposure, frame) in ((2, (0.7, 2)), (10, (1.6, 4))):
        want = np.zeros((2, 2))
        for y, x in itertools.product(range(4), range(4)):
            seen, slope = (
                light[frame, y, x] * exposure,
                slopes[:, frame, y, x] * exposure,
            )
            if seen < 1100:
                want += np.outer(slope, slope) / (seen + 3.3**2)
        assert found[place] == pytest.approx(want, rel=1e-9)


def test_a_plan_s_errors_are_of_all_its_frames_and_what_was_known(monkeypatch):
    random = np.random.default_rng(6)
    slopes = random.standard_normal((6, 2, 9)) * [[3.0], [0.2]]
    information = slopes @ slopes.transpose(0, 2, 1)
    rows = np.column_stack([np.linspace(400, 900, 6), np.zeros(6), np.ones(6)])
    names, prior = ("bias_nm", "distance_um"), np.diag([0.5**-2, 30.0**-2])
    monkeypatch.setattr(protocol, "_parameters", lambda *words: (names, prior))
    monkeypatch.setattr(
        protocol, "candidate_information", lambda *words: (rows, information)
    )
    monkeypatch.setattr(
        protocol, "_unstated", lambda *words: missing.UnmodelledShifts.none(2)
    )
    made = protocol.plan_captures(
        b.lens(), BenchProtocol((400.0, 900.0), frames=3), None
    )
    chosen = [int(np.flatnonzero(rows[:, 0] == d)[0]) for d in made.depth_um]
    for sigma, pick in ((made.sigma, chosen), (made.even_sigma, [0, 2, 5])):
        total = prior + sum(information[i] for i in pick)
        assert sigma == pytest.approx(np.sqrt(np.diag(np.linalg.inv(total))), rel=1e-9)
    assert made.gain[-1] == 1.0
    assert (np.diff(made.gain) > 0).all()


def test_what_is_known_of_the_bench_is_information_and_what_is_certain_is_not_fitted():
    known = (
        protocol.KnownValue("height_nm", 3.0, 2.5),
        protocol.KnownValue("distance_um", 0.0, 0.0),
    )
    names, prior = protocol._parameters(
        b.lens(), BenchProtocol((400.0, 900.0), known=known, free=("tilt_x_deg",))
    )
    assert "distance_um" not in names
    assert "tilt_x_deg" in names
    assert prior[names.index("height_nm")][names.index("height_nm")] == pytest.approx(
        2.5**-2
    )
    wide = protocol.PARAMETERS[protocol.PLACE["tilt_x_deg"]].sigma
    assert prior[names.index("tilt_x_deg")][names.index("tilt_x_deg")] == pytest.approx(
        wide**-2
    )


def test_what_nobody_states_is_judged_on_frames_as_bright_as_asked_for(monkeypatch):
    """At exposure 1 the brightest pixel has 7000 electrons; what is stated without
    doubt is not free.
    """
    monkeypatch.setattr(missing, "expected_score_tests", lambda task: task)
    unfitted = UNFITTED[0].name
    stated = (("height_nm", 3.0, 2.5), ("distance_um", 4.0, 0.0), (unfitted, 0.0, 0.37))
    known = tuple(protocol.KnownValue(*one) for one in stated)
    wanted = BenchProtocol(
        (380.0, 1150.0), pixel_um=1.5, pixels=16, peak_e=7000.0, full_well_e=3100.0, read_noise_e=3.3, known=known,
        free=("height_nm", "distance_um", "tilt_x_deg"),
    )  # fmt: skip
    frames = np.array([[420.0, 0.0, 0.5], [600.0, 2.0, 1.0], [900.0, 0.0, 2.0]])
    task = protocol._unstated(b.lens(), wanted, b.RESPONSE, frames)
    setting = task.model.setting
    assert setting.depth_um.tolist() == [420.0, 600.0, 900.0]
    assert setting.angle_rad == pytest.approx(
        np.array([[0, 0], [math.radians(2), 0], [0, 0]])
    )
    image = task.data.electrons
    plain = protocol.ForwardModel(
        b.lens(),
        protocol.FrameSetting(frames[:, 0], setting.angle_rad, np.ones(3), 1.5, 16, 16),
        b.RESPONSE,
    ).images(protocol.parameter_vector({"height_nm": 3.0, "distance_um": 4.0}))[0]
    want = 7000 * plain / plain.max() * frames[:, 2, None, None]
    assert image == pytest.approx(
        want, rel=1e-4, abs=1e-3 * 7000
    )  # a quick model of as many frames as there are
    assert (image / frames[:, 2, None, None]).max() == pytest.approx(7000, rel=1e-6)
    assert np.array_equal(task.data.saturated, image >= 3100)
    assert 0 < task.data.saturated.sum() < image.size
    assert task.data.usable.all()
    assert task.data.variance_e2 == pytest.approx(np.full(image.shape, 3.3**2))
    assert task.free == ("height_nm", "tilt_x_deg")
    assert task.unfitted == {unfitted: 0.37}
    assert set(task.known) == {"height_nm", "distance_um"}
