"""What a checkpoint says of itself, read without the module that wrote it."""

import json
from dataclasses import dataclass, field

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from codesign.train import checkpoint
from metalens.core.errors import TrainingError


@dataclass(frozen=True)
class Settings:
    steps: int = 10
    name: str = "plain"


def test_a_file_says_its_kind_its_version_and_where_every_tensor_stands(tmp_path):
    """Version 10: files of other versions are other states, whatever they are named."""
    state = {"a": [torch.tensor([1.5, -2.0]), 3], "b": {7: torch.ones(2, 3)[:, 1:]}}
    checkpoint.save(tmp_path / "c", state, settings=Settings())
    with safe_open(str(tmp_path / "c"), framework="pt") as file:
        about = json.loads(file.metadata()["about"])
        names = set(file.keys())
        assert file.get_tensor("/a/0").tolist() == [1.5, -2.0]
        assert file.get_tensor("/b/7").shape == (2, 2)
    assert (about["kind"], about["version"]) == ("checkpoint", 10)
    assert names == {"/a/0", "/b/7"}
    back = checkpoint.load(tmp_path / "c", settings=Settings())
    assert back["a"][1] == 3
    assert list(back["b"]) == [7]


@pytest.mark.parametrize(
    ("kind", "version"),
    [("checkpoint", 9), ("checkpoint", 11), ("subnet", 10), (None, 10)],
)
def test_another_kind_or_version_is_refused(tmp_path, kind, version):
    checkpoint._write(
        tmp_path / "c", {}, "about", json.dumps({"kind": kind, "version": version})
    )
    with pytest.raises(TrainingError, match="need 'checkpoint' version 10"):
        checkpoint.load(tmp_path / "c", settings=Settings())


def test_a_setting_that_holds_an_equals_sign_is_compared_whole():
    told = checkpoint.settings_difference(
        'steps = 10\nname = "a = b = c"\n', Settings(name="a = b = d")
    )
    assert told == 'name: "a = b = c" -> "a = b = d"'
    assert (
        checkpoint.settings_difference(
            'steps = 10\nname = "a = b"\n', Settings(name="a = b")
        )
        == ""
    )
    assert (
        checkpoint.settings_difference('name = "x"\n', Settings(name="x")) == ""
    )  # what is not known stands at its default
    assert (
        checkpoint.settings_difference("width = 3\n", Settings())
        == "width: 3 -> absent"
    )


def test_a_file_that_says_nothing_is_of_no_kind(tmp_path):
    save_file({"a": torch.ones(2)}, str(tmp_path / "c"))
    with pytest.raises(TrainingError, match="holds 'no kind' version no version"):
        checkpoint.load(tmp_path / "c", settings=Settings())


@dataclass(frozen=True)
class Part:
    steps: int = 4


@dataclass(frozen=True)
class Nested:
    steps: int = 3
    sides: tuple[int, ...] = field(default_factory=lambda: (5, 7))
    one: Part = field(default_factory=Part)
    other: Part = field(default_factory=Part)


def test_settings_of_one_name_in_two_tables_are_two_and_defaults_that_are_made_are_defaults():
    now = Nested(sides=(5, 8), one=Part(6))
    told = checkpoint.settings_difference("steps = 3\n", now).splitlines()
    assert told == ["one.steps: 4 -> 6", "sides: [5, 7] -> [5, 8]"]
    assert checkpoint.settings_difference("steps = 3\n", Nested()) == ""
    assert checkpoint.settings_difference(
        "steps = 3\n[one]\nsteps = 6\n[other]\nsteps = 9\n", now
    ) == ("other.steps: 9 -> 4\nsides: [5, 7] -> [5, 8]")
