"""Optimal design: against every possible choice, against evenly spread frames, and on the command line."""

import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import protocol
from characterize.bench.protocol import Protocol
from metalens import lens as lenses
from metalens.cli import main
from metalens.ground.errors import FitError

NAMES = ("bias_nm", "distance_um", "spherical_rad")
WANTED = Protocol((380.0, 1150.0), depth_count=6, frames=3, pixel_um=1.5, pixels=16, exposures=(0.5, 1.0))


@pytest.fixture(scope="module")
def candidates():
    random = np.random.default_rng(0)
    slopes = random.standard_normal((7, 3, 5)) * [[1.0], [0.5], [20.0]]
    return slopes @ slopes.transpose(0, 2, 1)


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_choice_is_the_best_of_all(candidates, criterion):
    prior = np.eye(3) * 1e-3

    def value(pick):
        return protocol.score(prior + candidates[list(pick)].sum(0), criterion, NAMES)

    found = protocol.choose(candidates, prior, 3, criterion=criterion, names=NAMES)
    best = max(itertools.combinations_with_replacement(range(7), 3), key=value)
    assert value(found) > 0.98 * value(best)  # exchanges may end in a local optimum


def test_plan_beats_frames_spread_evenly():
    found = protocol.plan(b.lens(), WANTED, b.RESPONSE)
    scale = [protocol.PARAMETERS[protocol.PLACE[n]].scale for n in found.names]
    ours, even = (np.square(s / scale).sum() for s in (found.sigma, found.even_sigma))
    assert ours < even
    assert np.all(np.diff(found.gain) > -1e-9)
    assert set(found.exposure) <= {0.5, 1.0}


def test_frames_that_saturate_tell_less():
    _, dim = protocol.candidate_information(b.lens(), WANTED, b.RESPONSE, NAMES)
    bright = Protocol((380.0, 1150.0), depth_count=6, pixel_um=1.5, pixels=16, exposures=(40.0,), full_well_e=9000.0)
    _, clipped = protocol.candidate_information(b.lens(), bright, b.RESPONSE, NAMES)
    full = Protocol((380.0, 1150.0), depth_count=6, pixel_um=1.5, pixels=16, exposures=(40.0,), full_well_e=1e9)
    _, whole = protocol.candidate_information(b.lens(), full, b.RESPONSE, NAMES)
    assert (np.trace(clipped, axis1=1, axis2=2) < np.trace(whole, axis1=1, axis2=2)).all()
    assert len(dim) == 2 * len(whole)


def test_protocol_on_the_command_line(tmp_path, capsys):
    lenses.save(tmp_path / "lens.h5", b.lens())
    (tmp_path / "p.toml").write_text(
        "depths_um = [380.0, 1150.0]\ndepth_count = 4\nframes = 2\npixel_um = 1.5\npixels = 16\n"
    )
    words = ["capture", str(tmp_path / "lens.h5"), "--protocol", str(tmp_path / "p.toml")]
    assert main([*words, "-o", str(tmp_path / "stage.csv"), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert len(values["frames"]) == 2
    assert values["sigma"]["bias_nm"] > 0
    lines = (tmp_path / "stage.csv").read_text().splitlines()
    assert lines[0] == "file,depth_um,angle_deg,exposure_s"
    assert len(lines) == 3
    assert main([*words, "--truth", str(tmp_path / "p.toml"), "-o", str(tmp_path / "x")]) == 2


def test_impossible_protocols_are_refused():
    with pytest.raises(FitError, match="nearest < farthest"):
        Protocol((2.0, 1.0))
