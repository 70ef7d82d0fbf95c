"""Which files of a window of pillars are written: those whose form may hold as many."""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.solid import files


@pytest.mark.parametrize(
    ("count", "names"),
    [
        (50_000, ["stl", "3mf", "glb"]),
        (50_001, ["stl", "3mf"]),
        (200_000, ["stl", "3mf"]),
        (200_001, ["stl"]),
    ],
)
def test_forms_that_hold_fewer_pillars_are_left_out(
    monkeypatch, tmp_path, count, names
):
    """Viewers of glTF take 50 000 and of 3MF 200 000, as their documentation and
    refusals say.
    """
    written = []
    monkeypatch.setattr(
        files,
        "_tile",
        lambda lens, process, window: SimpleNamespace(kind=np.zeros(count, np.uint8)),
    )
    for form in ("stl", "3mf", "gltf"):
        monkeypatch.setattr(
            files.solid,
            f"write_{form}",
            lambda path, pillars: written.append(path),
            raising=False,
        )
    made = files.write_stl(None, None, tmp_path, None)
    assert made == written == [tmp_path / f"pillars.{name}" for name in names]
