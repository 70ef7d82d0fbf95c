"""PROCESS.toml: round trip, refusals that name the key, bias and corner rounding
inverted together.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from layout.process import process
from layout.process.process import (
    DesignRules,
    DieSettings,
    EtchProfile,
    ExposureSettings,
    LayerTable,
    Process,
    WriteField,
)
from metalens.core import config
from metalens.core.errors import ConfigError, ProcessError
from metalens.fabrication import Spread

EXAMPLE = Path(__file__).parents[3] / "examples" / "process.toml"
DESIGN = np.arange(80, 340, 2.0)


def test_the_example_says_what_the_defaults_say_but_for_the_bias_and_the_wall():
    example = process.load_process(EXAMPLE)
    assert example.rules == DesignRules()
    assert example.layers == LayerTable()
    assert example.exposure == ExposureSettings(
        alpha_um=0.010, beta_um=31.0, eta=0.6, correct=True
    )
    assert example.write_field == WriteField()
    assert example.die == DieSettings()
    assert example.spread == Spread()


def test_a_process_survives_its_own_toml():
    example = process.load_process(EXAMPLE)
    assert config.loads(config.dumps(example), Process) == example


def test_the_drawn_pillar_makes_the_designed_one():
    example = process.load_process(EXAMPLE)
    for alone in (0.0, 0.4, 1.0):
        drawn = example.written_diameter_nm(DESIGN, alone)
        assert np.abs(example.made_diameter_nm(drawn, alone) - DESIGN).max() < 1e-8


def test_corner_rounding_takes_the_area_between_corner_and_arc():
    octagon = Process(
        rules=DesignRules(vertices=8), etch=EtchProfile(corner_radius_nm=20.0)
    )
    side_angle = math.pi / 8
    lost = 8 * 400 * (math.tan(side_angle) - side_angle)
    area = math.pi / 4 * 200**2 - lost
    want = math.sqrt(4 * area / math.pi)
    assert octagon.made_diameter_nm(200.0) == pytest.approx(
        want, abs=2e-3
    )  # next order: loss^2 / 2D = 1e-4 nm


def test_sidewall_spreads_top_and_foot_about_half_height():
    top, foot = Process(etch=EtchProfile(sidewall_deg=1.0)).top_foot_nm(200.0, 700.0)
    assert (foot - top) / 2 == pytest.approx(700 * math.tan(math.radians(1)))
    assert top + foot == pytest.approx(400)


def test_bias_and_exposure_tables_lie_beside_the_toml(tmp_path):
    (tmp_path / "bias.csv").write_text("100,-3\n200,0.5\n", encoding="utf-8")
    (tmp_path / "psf.csv").write_text("0.01,1\n1,0.1\n", encoding="utf-8")
    toml = tmp_path / "p.toml"
    toml.write_text(
        '[bias]\ncsv = "bias.csv"\n[exposure]\ncsv = "psf.csv"\n', encoding="utf-8"
    )
    found = process.load_process(toml)
    assert found.bias.table_nm == ((100.0, -3.0), (200.0, 0.5))
    assert found.exposure.csv == tmp_path / "psf.csv"
    (tmp_path / "psf.csv").unlink()
    with pytest.raises(ConfigError, match="no such file"):
        process.load_process(toml)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[rules]\nminimum_gap = 70\n", "minimum_gap_nm"),
        ("[rules]\ngrid_nm = 5\n", "multiple of the grid"),
        ("[rules]\ngrid_nm = 0\n", "above 0"),
        ("[rules]\nvertices = 30\n", "multiple of 4"),
        ("[rules]\nminimum_feature_nm = nan\n", "nan"),
        ("[rules]\nminimum_gap_nm = inf\n", "finite"),
        ("[rules]\nmaximum_density = 1.5\n", "share"),
        ("[layers]\npillar = [70000, 0]\n", "65535"),
        ("[layers]\npillar = [2, 0]\n", "both"),
        ("[layers]\npillar = [2]\n", "entries"),
        ('tone = "inverse"\n', "positive"),
        ("[exposure]\nalpha_um = 0.01\nbeta_um = 0.001\n", "exceed"),
        ("[exposure]\ncorrect = true\nalpha_um = 0.01\n", "beta_um, eta"),
        ("[exposure]\ngamma_um = 1.0\n", "both"),
        ("[exposure]\nmaximum_classes = 300\n", "255"),
        ("[exposure]\neta = -0.1\n", "eta"),
        ("[etch]\nsidewall_deg = 50\n", "45"),
        ("[etch]\ncorner_radius_nm = -1\n", "corner_radius_nm"),
        ("[write_field]\nsize_um = -1\n", "size_um"),
        ("[write_field]\nstitching_nm = -1\n", "stitching_nm"),
        ("[die]\nsize_um = [0, 1]\n", "size_um"),
        ("[die]\nstreet_um = -1\n", "street_um"),
        ("[spread]\nindex = -1\n", "index"),
        ('[bias]\ncsv = "absent.csv"\n', "cannot be read"),
    ],
)
def test_a_bad_process_file_is_refused_with_the_key(tmp_path, text, words):
    toml = tmp_path / "process.toml"
    toml.write_text(text, encoding="utf-8")
    with pytest.raises((ConfigError, ProcessError), match=words):
        process.load_process(toml)
