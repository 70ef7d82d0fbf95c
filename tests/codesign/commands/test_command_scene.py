"""``metalens scene`` from a config to files; bad configs are refused and leave nothing."""

import cv2

from metalens.core import store
from tests.command_line import call

TOML = "frames = 6\npixels = 64\npitch_um = 22.5\nseed = 4\nscale = 0.1\n"


def test_scene_writes_sheet_and_labels(tmp_path):
    source = tmp_path / "scene.toml"
    source.write_text(TOML)
    assert call(f"scene {source} -o {tmp_path}/out --quiet") == 0
    sheet = cv2.imread(str(tmp_path / "out" / "sheet.png"), cv2.IMREAD_GRAYSCALE)
    assert sheet.shape == (3 * 64, 6 * 64)
    assert sheet[:64].std() > 20
    lines = (tmp_path / "out" / "labels.csv").read_text().splitlines()
    assert len(lines) == 7
    assert len(lines[0].split(",")) == len(lines[1].split(","))
    assert store.load(tmp_path / "out" / "scene.h5", "scene").provenance.seed == 4


def test_variety_changes_the_frames_and_is_reproducible(tmp_path):
    sheets = []
    for name, variety in (("bare", 1.0), ("worn", 2.5), ("again", 2.5)):
        (tmp_path / "scene.toml").write_text(TOML + f"variety = {variety}\n")
        assert call(f"scene {tmp_path}/scene.toml -o {tmp_path}/{name} --quiet") == 0
        sheets.append((tmp_path / name / "sheet.png").read_bytes())
    assert sheets[0] != sheets[1] == sheets[2]


def test_bad_scene_is_refused_with_the_key(tmp_path, capsys):
    source = tmp_path / "scene.toml"
    source.write_text("distance_mm = 0.0\n")
    assert call(f"scene {source} -o {tmp_path}/out") == 2
    assert "distance_mm" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    source.write_text("variety = 5.0\n")
    assert call(f"scene {source} -o {tmp_path}/out") == 2
    assert "variety = 5.0: need 0 to 4" in capsys.readouterr().err
