"""A free-form lens from the command line, beside tuned lenses, and a design that is
made for field angles too.
"""

import json

import numpy as np
import pytest
import torch

from metalens import cli, lens
from metalens.core import config
from metalens.core.errors import ConfigError
from metalens.design import Focus
from metalens.design.free_form import report as design_fisher_report
from metalens.design.free_form import search as free
from metalens.design.free_form import simple_lenses as baselines
from metalens.design.free_form.search import FisherSettings
from metalens.image.pupil import Pupil

SMALL = Pupil(radius_um=150.0, nodes=80)
FOCUS = Focus(0.85, 2000.0, 20e3)
TOML = """profile = "fisher"
aperture_mm = 0.12
[fisher]
iterations = 3
starts = 1
grids = [6, 0]
encircled = 0.1
angles_deg = [0.0, 10.0]
"""


def test_the_command_compares_with_tuned_lenses_and_draws(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(baselines, "ZONES", (1,))
    (tmp_path / "design.toml").write_text(TOML)
    out = tmp_path / "lens.h5"
    assert (
        cli.main(["design", str(tmp_path / "design.toml"), "-o", str(out), "--json"])
        == 0
    )
    found = json.loads(capsys.readouterr().out)["fisher"]
    names = list(found["lenses"])
    assert names[0] == "free form"
    assert "hyperbolic" in names[1]
    assert "helix" in names[2]
    means = [np.mean(v["information_per_mm2"]) for v in found["lenses"].values()]
    assert found["times_the_better_baseline"] == pytest.approx(
        means[0] / max(means[1:])
    )
    assert np.shape(found["lenses"]["free form"]["encircled_energy"]) == (2, 11)
    assert (tmp_path / "lens_fisher.png").read_bytes().startswith(b"\x89PNG")
    assert lens.load(out).profile == "fisher"


def test_the_table_names_every_angle_and_the_energy():
    settings = FisherSettings(
        angles_deg=(0.0, 8.0), iterations=4, starts=1, grids=(5,), encircled=0.0
    ).about(FOCUS, 150.0)
    made = free.optimize_free_form(SMALL, settings)
    assert made.score.information.shape == (2, 11)
    flat = torch.zeros(80, 80, dtype=torch.float64)
    scores = [
        free.score_phase(p, SMALL, focus_um=20e3, settings=settings)
        for p in (free.phase_on(SMALL, made), flat)
    ]
    lenses = tuple(
        design_fisher_report.JudgedLens(n, flat, 20e3, s)
        for n, s in zip("ab", scores, strict=True)
    )
    text = design_fisher_report.report_text(lenses, settings)
    assert "8°" in text
    assert f"{float(scores[0].information[1].mean()):.3f}" in text
    assert (
        f"{design_fisher_report.information_gain(lenses):.2f} x the better baseline"
        in text
    )


def test_a_design_for_field_angles_gains_at_both():
    """From random noise, 24 steps: more information off axis than a focused lens, the
    energy kept at all angles.
    """
    settings = FisherSettings(
        depths_mm=(16.0, 26.0),
        pixel_um=3.0,
        radius_um=18.0,  # closer than this lens tells apart by itself
        angles_deg=(0.0, 8.0),
        iterations=24,
        starts=1,
        grids=(6, 0),
        encircled=0.4,
        focus_mm=(20.0, 20.0),
    ).about(FOCUS, 150.0)
    made = free.optimize_free_form(SMALL, settings)
    plain = free.score_phase(
        torch.zeros(80, 80, dtype=torch.float64),
        SMALL,
        focus_um=20e3,
        settings=settings,
    )
    assert bool(
        (made.score.information.mean(1) > 1.1 * plain.information.mean(1)).all()
    )
    assert float(made.score.encircled.min()) > 0.39


def test_angles_that_no_lens_sees_are_refused():
    for wish in ("angles_deg = []", "angles_deg = [50.0]", "angles_deg = [-5.0]"):
        with pytest.raises(ConfigError, match="angles_deg"):
            config.loads(wish, FisherSettings)
