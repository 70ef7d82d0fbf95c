"""A folder's manifest by its entries, and how far into a file its maker's mark is
looked for, to the byte.
"""

import hashlib
import json
import os

import pytest

from metalens.ground import manifest
from metalens.ground.errors import StoreError


def folder(tmp_path):
    place = tmp_path / "run"
    (place / "sub").mkdir(parents=True)
    (place / "a.txt").write_bytes(b"seven b")
    (place / "sub" / "c.bin").write_bytes(b"xyz")
    (place / "mine.txt").write_bytes(b"!")
    return place


def test_a_manifest_lists_every_file_but_others(tmp_path):
    place = folder(tmp_path)
    manifest.write(place, "psf a b", others=["mine.txt"])
    text = (place / "manifest.json").read_text()
    assert text.endswith("}\n")
    assert text.startswith('{\n "kind": "metalens folder",\n "version": 1,\n')
    told = json.loads(text)
    assert told["files"] == {
        "a.txt": {"sha256": hashlib.sha256(b"seven b").hexdigest(), "bytes": 7},
        "sub/c.bin": {"sha256": hashlib.sha256(b"xyz").hexdigest(), "bytes": 3},
    }
    assert (told["finished"], told["others"], told["command"]) == (
        True,
        ["mine.txt"],
        "psf a b",
    )
    found = manifest.read(place)
    assert (found["files"], found["others"]) == (told["files"], told["others"])
    manifest.check(place)
    manifest.write(place, "psf a b", finished=False)
    assert json.loads((place / "manifest.json").read_text())["files"] == {}
    with pytest.raises(StoreError, match="is unfinished"):
        manifest.check(place)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.txt", b"seven c", "SHA-256 differs"),
        ("a.txt", b"seven", "SHA-256 differs"),
        ("a.txt", None, "is missing"),
    ],
)
def test_what_is_no_longer_as_it_was_written_is_told(tmp_path, name, content, told):
    place = folder(tmp_path)
    manifest.write(place, "psf")
    (place / "new.txt").touch()  # added since: left alone
    manifest.check(place)
    if content is None:
        (place / name).unlink()
    else:
        (place / name).write_bytes(content)
    with pytest.raises(StoreError, match=told):
        manifest.check(place)


@pytest.mark.parametrize(
    ("more", "told"), [(1, "too large"), (0, "Expecting value|decode|invalid")]
)
def test_a_manifest_of_more_than_64_mebibytes_is_not_read(tmp_path, more, told):
    (tmp_path / "manifest.json").touch()
    os.truncate(tmp_path / "manifest.json", (1 << 26) + more)
    with pytest.raises(StoreError, match=told):
        manifest.read(tmp_path)
    assert manifest.read(tmp_path / "none") is None


def test_another_kind_or_version_is_refused(tmp_path):
    place = folder(tmp_path)
    manifest.write(place, "psf")
    plain = json.loads((place / "manifest.json").read_text())
    for other in ({"kind": "folder"}, {"version": 2}):
        (place / "manifest.json").write_text(json.dumps(plain | other))
        with pytest.raises(StoreError, match="version 1"):
            manifest.read(place)


PNG, MARK = b"\x89PNG", b"Software\0metalens"


@pytest.mark.parametrize(
    ("content", "ours"),
    [
        (
            PNG + b"." * (4096 - 4 - len(MARK)) + MARK + b"." * 100,
            True,
        ),  # ends with the first 4096 bytes
        (PNG + b"." * (4097 - 4 - len(MARK)) + MARK + b"." * 100, False),
        (
            b"PK" + b"." * 5000 + b"metalens" + b"." * 56,
            True,
        ),  # begins with the last 64
        (b"PK" + b"." * 5000 + b"metalens" + b"." * 57, False),
        (b"PK" + b"." * 9 + b"metalens", True),  # of a short file too
        (b"PX" + b"." * 9 + b"metalens", False),
        (b"II*\0" + b"." * (65536 - 12) + b"metalens" + b"." * 70000, True),
        (b"II*\0" + b"." * (65537 - 12) + b"metalens" + b"." * 70000, False),
        (b"MM\0*" + b"." * 70000 + b"metalens" + b"." * (65536 - 8), True),
        (b"MM\0*" + b"." * 70000 + b"metalens" + b"." * (65537 - 8), False),
        (b"II+\0" + b"...metalens", True),
        (b"II+\0" + b"...metal lens", False),
        (b"any words", False),
    ],
)
def test_a_mark_is_looked_for_at_a_files_beginning_and_end(tmp_path, content, ours):
    (tmp_path / "f").write_bytes(content)
    assert (manifest.foreign(tmp_path / "f") == "") is ours
    assert "cannot be read" in manifest.foreign(tmp_path / "none")


def test_a_folder_is_ours_with_a_manifest_that_lists_all(tmp_path):
    place = folder(tmp_path)
    assert (
        manifest.foreign(place)
        == "holds a.txt and no manifest.json: not made by metalens"
    )
    manifest.write(place, "psf")
    assert manifest.foreign(place) == ""
    (place / "z.txt").touch()
    (place / "new.txt").touch()
    assert manifest.foreign(place) == "holds new.txt, which metalens did not make"
    assert manifest.strange(place) == {"z.txt", "new.txt"}
    manifest.write(place, "psf", finished=False)
    assert (
        manifest.foreign(place) == ""
    )  # an unfinished one may hold what it has not listed yet
    (tmp_path / "bare").mkdir()
    assert manifest.foreign(tmp_path / "bare") == ""
    (tmp_path / "bare" / "manifest.json").write_text("{}")
    assert "damaged" in manifest.foreign(tmp_path / "bare")


def test_a_folder_inside_with_a_manifest_of_its_own_is_not_strange(tmp_path):
    place = folder(tmp_path)
    manifest.write(place / "sub", "fit")
    (place / "sub" / "extra").touch()
    assert manifest.strange(place) == {"a.txt", "mine.txt", "sub/extra"}
    manifest.write(place, "psf", others=["mine.txt"])
    assert manifest.strange(place) == {"mine.txt"}


def test_names_are_from_the_folder_on_and_links_to_folders_count(tmp_path):
    place = folder(tmp_path)
    (place / "manifest.json").touch()
    (place / "sub" / "manifest.json").touch()
    (place / "link").symlink_to(place / "sub")
    assert sorted(manifest.files(place)) == [
        "a.txt",
        "link",
        "mine.txt",
        "sub/c.bin",
        "sub/manifest.json",
    ]
    manifest.empty(place)
    assert sorted(os.listdir(place)) == ["manifest.json"]


def test_a_journal_goes_on_under_its_own_title_and_begins_afresh_under_another(
    tmp_path,
):
    path = tmp_path / "j"
    assert manifest.journal(path, '["1", "psf"]') == []
    with open(path, "a") as file:
        file.write("one\ntwo\ncut")
    assert manifest.journal(path, '["1", "psf"]') == ["one", "two"]
    assert manifest.journal(path, '["1", "fit"]') == []
    assert path.read_text() == '["1", "fit"]\n'
    path.write_text("")
    assert manifest.journal(path, '"2"') == []
    for words in ("no journal\n", "{}\n"):
        path.write_text(words)
        with pytest.raises(StoreError, match="is in the way"):
            manifest.journal(path, '"2"')
        assert path.read_text() == words
