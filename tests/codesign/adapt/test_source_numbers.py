"""What a run that is taken up holds: its rows in order, its network, and how far
another lens may be off.
"""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.adapt import source
from codesign.adapt.settings import RetrainConfig
from codesign.network import Space, smallest
from metalens.ground.errors import ConfigError, FitError, TrainingError
from metalens.lens.record import DiameterMap
from tests.codesign import made_lens as m


def written(folder, rows):
    (folder / "result.json").write_text(json.dumps({"rows": rows}))
    return folder


def test_rows_come_with_the_least_budget_first(tmp_path):
    rows = [{"budget_mmacs": b, "n": n} for n, b in enumerate((8.0, 2.0, 31.0, 5.5))]
    assert [row["n"] for row in source.rows_of(written(tmp_path, rows))] == [1, 3, 0, 2]
    with pytest.raises(TrainingError, match="holds no network"):
        source.rows_of(written(tmp_path, []))
    with pytest.raises(TrainingError, match="cut short or of another version"):
        source.rows_of(written(tmp_path, [{"n": 3}]))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A run of three networks; what reads its checkpoint gives names."""
    for name in ("run.toml", "checkpoint.safetensors", "lens.h5"):
        (tmp_path / name).write_text("")
    rows = [
        {"budget_mmacs": b, "architecture": a}
        for a, b in (("third", 9.0), ("first", 2.0), ("second", 4.5))
    ]
    written(tmp_path, rows)
    monkeypatch.setattr(source.runs, "load", lambda path: f"settings of {path.name}")
    monkeypatch.setattr(
        source.runs, "resume", lambda path, settings: (path.name, settings)
    )
    monkeypatch.setattr(
        source, "architecture_of", lambda entry, run, folder: f"{entry} network"
    )
    return tmp_path


def test_without_a_budget_the_largest_network_is_taken(folder):
    found = source.load(folder)
    assert (found.row["budget_mmacs"], found.architecture) == (9.0, "third network")
    assert found.run == ("checkpoint.safetensors", "settings of run.toml")
    assert found.made is None
    for budget, name in ((2.0, "first"), (4.5, "second"), (9.0, "third")):
        assert (
            source.load(folder, budget_mmacs=budget).architecture == f"{name} network"
        )
    with pytest.raises(
        TrainingError, match=r"no network of 3 MMACs; its budgets are 2, 4\.5, 9"
    ):
        source.load(folder, budget_mmacs=3.0)


@pytest.mark.parametrize(
    "name", ["run.toml", "checkpoint.safetensors", "lens.h5", "result.json"]
)
def test_one_missing_file_of_four_is_a_half_written_run(folder, name):
    (folder / name).unlink()
    with pytest.raises(TrainingError, match=f"half-written run: {name} missing"):
        source.load(folder)


def test_an_architecture_is_read_as_it_was_written_without_its_error_and_cost():
    space = Space(widths=(0.25,), depths=(2,), expansions=(3,), kernels=(3,))
    run = SimpleNamespace(
        trainer=SimpleNamespace(model=SimpleNamespace(net=None)),
        settings=SimpleNamespace(space=space),
    )
    chosen = smallest(space)
    told = {
        name: list(v) if isinstance(v := getattr(chosen, name), tuple) else v
        for name in chosen.__slots__
    }
    assert (
        source.architecture_of({**told, "error": 0.3, "macs": 7e6}, run, Path("x"))
        == chosen
    )
    with pytest.raises(
        TrainingError, match=r"x/result\.json: its network is of another version"
    ):
        source.architecture_of({**told, "colour": 3}, run, Path("x"))
    with pytest.raises(TrainingError, match="its network is of another version"):
        source.architecture_of(None, run, Path("x"))


@pytest.mark.parametrize(
    ("off_um", "same"),
    [(0.9e-6, True), (-0.9e-6, True), (1.1e-6, False), (-1.1e-6, False)],
)
def test_diameters_of_one_lens_agree_to_a_picometre(off_um, same):
    lens = m.small()
    d = lens.diameters
    other = d.diameter_um.copy()
    middle = other.shape[0] // 2
    other[middle, middle + 3] += off_um
    fitted = m.asbuilt(made=replace(lens, diameters=DiameterMap(other, d.pitch_um)))
    if same:
        source.check_lens(lens, fitted)
    else:
        with pytest.raises(
            FitError, match=r"designed diameters differ by up to 0\.0 nm"
        ):
            source.check_lens(lens, fitted)


def test_a_lens_of_another_pitch_or_distance_is_another():
    lens = m.small()
    d = lens.diameters
    with pytest.raises(FitError, match=r"pitch 0\.41 um"):
        source.check_lens(
            lens,
            m.asbuilt(made=replace(lens, diameters=DiameterMap(d.diameter_um, 0.41))),
        )
    far = SimpleNamespace(
        design=SimpleNamespace(
            diameters=d, sensor_distance_um=lens.sensor_distance_um + 0.5
        ),
        trusted=True,
        problems=(),
    )
    with pytest.raises(FitError, match=r"distances are 300\.0 and 300\.5 um"):
        source.check_lens(lens, far)
    thick = d.diameter_um + np.where(d.diameter_um > 0, 0.0043, 0.0)
    off = SimpleNamespace(
        design=SimpleNamespace(
            diameters=SimpleNamespace(diameter_um=thick, pitch_um=d.pitch_um),
            sensor_distance_um=lens.sensor_distance_um,
        ),
        trusted=True,
    )
    with pytest.raises(FitError, match=r"differ by up to 4\.3 nm"):
        source.check_lens(lens, off)


def test_how_a_network_is_trained_on():
    usual = RetrainConfig()
    told = (
        usual.steps,
        usual.rate,
        usual.draws,
        usual.judge,
        usual.test_batches,
        usual.seed,
        usual.budget_mmacs,
    )
    assert told == (200, 1.5e-3, 8, 4, 16, 0, 0.0)
    assert RetrainConfig(steps=1, draws=1, judge=1, test_batches=1, seed=0, rate=1e-12)
    for name in ("steps", "draws", "judge", "test_batches"):
        with pytest.raises(ConfigError, match="1 or more"):
            RetrainConfig(**{name: 0})
    for odd in ({"rate": 0.0}, {"rate": float("nan")}, {"seed": -1}):
        with pytest.raises(ConfigError, match="a seed of 0 or more, a rate above 0"):
            RetrainConfig(**odd)
