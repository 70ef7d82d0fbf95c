"""What a command will need is checked before its work begins."""

import dataclasses
import importlib
import typing
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

import layout
from characterize.captures import capture as captures
from layout.formats import gdsii_read
from layout.process import Process
from metalens import cli, lens
from metalens.cell.record import Cell, Index
from metalens.cli import BAD_INPUT, main
from metalens.commands import design
from metalens.commands.library import CellFile
from metalens.core import config, transaction
from metalens.lens.record import DiameterMap, Lens
from metalens.pillars.proxy import Proxy


@pytest.fixture
def untouched(monkeypatch):
    """The work of the commands, which must not begin."""

    def begin(*_, **__):
        pytest.fail("the work began")

    monkeypatch.setattr(captures, "load", begin)
    monkeypatch.setattr(gdsii_read, "read", begin)
    monkeypatch.setattr(design, "_phase", begin)


def test_outputs_that_cannot_be_written_are_refused_before_inputs_are_read(
    tmp_path, untouched, capsys
):
    (tmp_path / "mask.gds").write_bytes(b"\0\6\0\2\0\7")
    (tmp_path / "taken").write_text("mine")
    for words in (
        ["measure", str(tmp_path), "-o", str(tmp_path / "no" / "out")],
        ["check", str(tmp_path / "mask.gds"), "-o", str(tmp_path / "no" / "out.lyrdb")],
        ["measure", str(tmp_path), "-o", str(tmp_path / "taken")],
        ["check", str(tmp_path / "mask.gds"), "-o", str(tmp_path / "taken"), "--force"],
    ):
        assert main(words) == BAD_INPUT
        told = capsys.readouterr().err
        assert "does not exist" in told or "taken" in told
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_wavelength_outside_the_library_is_refused_before_the_search(
    tmp_path, untouched, monkeypatch, capsys
):
    proxy = Proxy(
        np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.84, 0.86), 0.0, 0.0
    )
    swept = SimpleNamespace(cell=Cell(0.3, pillar=Index(3.6)))
    monkeypatch.setattr(design, "_pillars", lambda *_: (swept, {}))
    monkeypatch.setattr(design.library, "proxy_of", lambda _: proxy)
    (tmp_path / "d.toml").write_text(
        'profile = "fisher"\nwavelength_nm = 940.0\naperture_mm = 0.05\n'
    )
    assert (
        main(["design", str(tmp_path / "d.toml"), "-o", str(tmp_path / "l.h5")])
        == BAD_INPUT
    )
    assert (
        "um, but the proxy holds from 0.84 to 0.86 um: sweep a library over the wavelengths"
        in capsys.readouterr().err
    )


# verb: words that need an output, with inputs that are there; and what must not be
# called
NEEDS = {
    "library": ("cell.toml", "metalens.pillars.sweep:sweep"),
    "field": ("cell.toml --diameter-um 0.12", "metalens.commands.field:near_fields"),
    "design": ("design.toml", "metalens.commands.design:_make"),
    "psf": ("lens.h5", "metalens.commands.psf:_compute"),
    "export": ("lens.h5", "metalens.lens.export:export_lens"),
    "scene": ("scene.toml", "codesign.commands.scene:_make"),
    "layout": ("lens.h5", "layout.commands.make:draw_lens"),
    "capture": (
        "lens.h5 --truth truth.toml",
        "characterize.bench.bench:simulate_frames",
    ),
    "measure": ("captures", "characterize.commands.measure:_frames"),
    "fit": ("captures --design lens.h5", "characterize.commands.fit:fit"),
    "codesign": ("run.toml", "codesign.commands.codesign:_work"),
    "evaluate": ("optics lens.h5", "codesign.commands.evaluate_optics:_measure"),
    "budget": ("lens.h5", "codesign.commands.budget:prepare_device"),
    "check": ("mask.gds", "layout.drc:check_library"),
    "study": ("", "metalens.pillars.study:run_study"),
    "view": ("lens.h5", "metalens.commands.view:_shown"),
}
NAMES = {"library": "o.h5", "field": "o.h5", "design": "o.h5", "psf": "o.h5", "export": "o.npz", "fit": "o.h5",
         "budget": "o.h5", "check": "o.lyrdb", "view": "o.html"}  # fmt: skip


@pytest.fixture
def inputs(tmp_path, monkeypatch):
    """Small good inputs of every verb, in the current folder."""
    monkeypatch.chdir(tmp_path)
    proxy = Proxy(
        np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0
    )
    diameters = np.linspace(0.08, 0.21, 36, dtype=np.float32).reshape(6, 6)
    made = Lens(
        DiameterMap(diameters, 0.3),
        Cell(0.3, pillar=Index(3.6)),
        proxy,
        0.85,
        2000.0,
        20_000.0,
        "map",
    )
    lens.save("lens.h5", made)
    layout.write_gdsii(layout.plan(made, Process()), "mask.gds")
    texts = {"cell": "[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n", "design": "aperture_mm = 0.02\n", "scene": "",
             "truth": "depths_um = [20000.0]\n", "run": 'preset = "smoke"\n'}  # fmt: skip
    for name, text in texts.items():
        (tmp_path / f"{name}.toml").write_text(text)
    (tmp_path / "captures").mkdir()
    frames = np.arange(3 * 12 * 14, dtype=np.uint16).reshape(3, 12, 14) % 97
    tifffile.imwrite(tmp_path / "captures" / "f.tif", frames, photometric="minisblack")
    rows = "".join(f"f.tif,{k},{18 + k},0.0,0.01\n" for k in range(3))
    (tmp_path / "captures" / "stage.csv").write_text(
        "file,page,depth_mm,angle_deg,exposure_s\n" + rows
    )
    (tmp_path / "captures" / "capture.toml").write_text(
        "pixel_um = 3.0\nwavelength_um = 0.85\nbits = 10\n"
    )
    return tmp_path


def tree(folder):
    return {
        p.relative_to(folder).as_posix(): p.is_file() and p.read_bytes()
        for p in folder.rglob("*")
    }


@pytest.mark.parametrize("verb", sorted(NEEDS))
def test_no_command_begins_where_its_output_cannot_stand(
    inputs, monkeypatch, capsys, verb
):
    """No folder, a file for a folder, another's work, its own input by links, no name,
    the folder of its input.
    """
    words, work = NEEDS[verb]
    module, _, name = work.partition(":")
    monkeypatch.setattr(
        importlib.import_module(module),
        name,
        lambda *_, **__: pytest.fail("the work began"),
    )
    output = NAMES.get(verb, "o")
    (inputs / "thesis").mkdir()
    (inputs / "thesis" / output).write_text("years of work")
    (inputs / "file").write_text("mine")
    first = next(
        (w for w in words.split() if "." in w and not w.startswith("-")), "lens.h5"
    )
    targets = [
        f"no/{output}",
        f"file/{output}",
        f"thesis/{output}",
        ".",
        "/",
        f"{'x' * 300}{output}",
    ]
    if verb in NAMES:
        (inputs / f"link{output}").symlink_to(inputs / first)
        (inputs / f"hard{output}").hardlink_to(inputs / first)
        targets += ["thesis", f"link{output}", f"hard{output}"]
    else:
        targets += ["thesis", "file", str(inputs)]
    if verb == "codesign":  # which makes the folders above its own
        targets.remove(f"no/{output}")
    before = tree(inputs)
    for target in targets:
        assert main([verb, *words.split(), "-o", target, "--force"]) == BAD_INPUT, (
            target
        )
        told = capsys.readouterr().err
        assert "not foreseen" not in told
        assert told.count("\n") == 1, told
        assert tree(inputs) == before


def numbers(options):
    """(option, how many values it takes) of the numbers with a point, those of tables
    within left out.
    """
    for name, hint in typing.get_type_hints(options).items():
        text = str(hint)
        if "float" in text and not dataclasses.is_dataclass(hint):
            listed = "..." not in text and "tuple" in text
            yield f"--{name.replace('_', '-')}", text.count("float") if listed else 1


@pytest.mark.parametrize("verb", sorted(NEEDS))
def test_no_command_begins_with_a_number_out_of_this_world(
    inputs, monkeypatch, capsys, verb
):
    words, work = NEEDS[verb]
    module, _, name = work.partition(":")
    monkeypatch.setattr(
        importlib.import_module(module),
        name,
        lambda *_, **__: pytest.fail("the work began"),
    )
    module = importlib.import_module(cli.VERBS[verb][0])
    first, *rest = [verb, *words.split()]
    parts = getattr(module, "PARTS", {})
    options = (importlib.import_module(parts[rest[0]][0]) if parts else module).Options
    before = tree(inputs)
    for option, count in numbers(options):
        for bad in ("nan", "inf", "-inf", "1e20"):
            if (option, bad) in {
                ("--sources-mm", "inf"),
                ("--reference-e", "nan"),
            }:  # a plane wave; the default
                continue
            assert (
                main([first, *rest, option, *[bad] * count, "-o", NAMES.get(verb, "o")])
                == BAD_INPUT
            )
            told = capsys.readouterr().err
            assert option in told, told
            assert "need a finite number" in told
            assert tree(inputs) == before


def test_a_diode_of_less_than_no_width_is_refused_before_the_budget(
    inputs, monkeypatch, capsys
):
    monkeypatch.setattr(
        "codesign.budget.links.budget_entries",
        lambda *_, **__: pytest.fail("the work began"),
    )
    assert main(["budget", "lens.h5", "--led-fwhm-nm", "-1", "-o", "o.h5"]) == BAD_INPUT
    assert "--led-fwhm-nm -1: need 0 or more" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", ["budget lens.h5 -o o.h5", "retrain run --asbuilt asbuilt.h5 -o o"]
)
def test_a_process_is_refused_whole_by_those_who_read_a_part_of_it(
    inputs, capsys, words
):
    """A misspelt table would be a budget without it; the matrix of bad values holds the
    rest.
    """
    for text, told in (
        ("[spraed]\n", "unknown key 'spraed'; did you mean 'spread'?"),
        ("tone = 7\n", "tone"),
    ):
        (inputs / "p.toml").write_text(text)
        assert main([*words.split(), "--process", "p.toml"]) == BAD_INPUT
        said = capsys.readouterr().err
        assert said.startswith("metalens: error: p.toml: ")
        assert told in said


def test_options_that_would_do_nothing_are_refused(inputs, capsys):
    assert main(["export", "lens.h5", "-o", "o.npz", "--samples", "31"]) == BAD_INPUT
    assert "--samples 31: counts the points of a .dat" in capsys.readouterr().err
    assert main(["check", "mask.gds", "--layers", "3:1"]) == BAD_INPUT
    assert "--layers 3:1: need LAYER or LAYER/DATATYPE" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["library", "study", "capture", "layout"])
def test_no_command_begins_where_its_workers_cannot_be_had(
    inputs, monkeypatch, capsys, verb
):
    words, work = NEEDS[verb]
    module, _, name = work.partition(":")
    monkeypatch.setattr(
        importlib.import_module(module),
        name,
        lambda *_, **__: pytest.fail("the work began"),
    )
    words = [
        verb,
        *words.split(),
        *(["--study"] if verb == "layout" else []),
        "-o",
        NAMES.get(verb, "o"),
    ]
    asked = {
        "--workers 0": "0 workers: need 1 to 1024",
        "--workers 4611686018427387904": "4611686018427387904 workers: need 1 to 1024",
    }
    before = tree(inputs)
    for more, told in asked.items():
        assert main([*words, *more.split()]) == BAD_INPUT
        assert told in capsys.readouterr().err
        assert tree(inputs) == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("layout lens.h5 -o o", "the work of --study"),
        ("capture lens.h5 --plan truth.toml -o o.csv", "frames of --truth"),
    ],
)
def test_workers_with_nothing_to_do_are_refused(inputs, capsys, words, told):
    assert main([*words.split(), "--workers", "2"]) == BAD_INPUT
    assert told in capsys.readouterr().err
    assert not {path.name for path in inputs.iterdir()} & {"o", "o.csv"}


@pytest.mark.parametrize(
    "words",
    [
        "library cell.toml -o o.png",
        "design design.toml -o o.png",
        "budget lens.h5 -o o.png",
    ],
)
def test_a_result_does_not_take_the_name_of_its_own_picture(inputs, capsys, words):
    assert main(words.split()) == BAD_INPUT
    assert "o.png" in capsys.readouterr().err
    assert not (inputs / "o.png").exists()


@pytest.mark.parametrize("verb", sorted(NEEDS))
def test_no_command_begins_on_a_full_disk(inputs, monkeypatch, capsys, verb):
    words, work = NEEDS[verb]
    module, _, name = work.partition(":")
    monkeypatch.setattr(
        importlib.import_module(module),
        name,
        lambda *_, **__: pytest.fail("the work began"),
    )
    monkeypatch.setattr(
        transaction.shutil,
        "disk_usage",
        lambda _: SimpleNamespace(free=transaction.ROOM - 1),
    )
    before = tree(inputs)
    assert main([verb, *words.split(), "-o", NAMES.get(verb, "o")]) == BAD_INPUT
    told = capsys.readouterr().err
    assert "4.19 MB free, need " in told
    assert "make room first" in told
    assert tree(inputs) == before


@pytest.mark.parametrize(
    ("words", "needed"),
    [
        ("psf lens.h5 --config psf.toml -o o.h5", 4 * 3 * 2 * 60**2),
        ("scene scene.toml -o o", 4 * 70 * 90**2),
        ("capture lens.h5 --truth truth.toml -o o", 2 * (2 + 3 + 5) * 80**2),
        ("fit captures --design lens.h5 -o o.h5", 2 * 3 * 12 * 14),
    ],
)
def test_the_room_asked_for_is_that_of_the_result(
    inputs, monkeypatch, capsys, words, needed
):
    """Bytes of what is certainly written, beside what every output may need; one byte
    less is refused.
    """
    (inputs / "psf.toml").write_text(
        "depths_mm = [18.0, 22.0, 2.0]\nangles_deg = [0.0, 7.0]\nsamples = 60\n"
    )
    (inputs / "scene.toml").write_text("frames = 70\npixels = 90\n")
    camera = "dark_frames = 3\nflat_frames = 5\n[camera]\npixels = 80\n"
    (inputs / "truth.toml").write_text(f"depths_um = [20000.0, 24000.0]\n{camera}")
    for verb in ("psf", "scene", "capture", "fit"):
        module, _, name = NEEDS[verb][1].partition(":")
        monkeypatch.setattr(
            importlib.import_module(module), name, lambda *_, **__: 1 / 0
        )
    for free, told in ((needed - 1, "make room first"), (needed, "ZeroDivisionError")):
        usage = SimpleNamespace(free=transaction.ROOM + free)
        monkeypatch.setattr(
            transaction.shutil, "disk_usage", lambda _, usage=usage: usage
        )
        assert main(words.split()) == BAD_INPUT
        assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "needed"),
    [
        (
            "design design.toml -o o.h5",
            20_000,
        ),  # 4 bytes for every site of a disc 0.023 mm wide at 0.288 um: 20 039
        ("layout lens.h5 --oasis -o o", 36),
        ("layout lens.h5 -o o", 36 + 28 * 36),  # a reference of GDSII for each pillar
        ("export lens.h5 -o o.npz", 144),
        ("export lens.h5 -o o.dat --samples 70", 12 * 70**2),
    ],
)
def test_room_is_asked_for_as_soon_as_the_size_is_known(
    inputs, monkeypatch, capsys, words, needed
):
    """Here from the lens or the library, after the claim."""
    proxy = Proxy(
        np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.84, 0.86), 0.0, 0.0
    )
    swept = SimpleNamespace(cell=Cell(0.288, pillar=Index(3.6)))
    monkeypatch.setattr(design, "_pillars", lambda *_: (swept, {}))
    monkeypatch.setattr(design.library, "proxy_of", lambda _: proxy)
    (inputs / "design.toml").write_text("aperture_mm = 0.023\n")
    for name in (
        "metalens.lens.export:export_lens",
        "layout.mask.build:draw_mask",
        "metalens.commands.design:_phase",
    ):
        module, _, word = name.partition(":")
        monkeypatch.setattr(
            importlib.import_module(module), word, lambda *_, **__: 1 / 0
        )
    for free, told in (
        (0.99 * needed, "make room first"),
        (1.01 * needed + 50, "ZeroDivisionError"),
    ):
        seen = iter([transaction.ROOM])
        monkeypatch.setattr(
            transaction.shutil,
            "disk_usage",
            lambda _, s=seen, free=free: SimpleNamespace(free=next(s, free)),
        )
        assert main(words.split()) == BAD_INPUT
        assert told in capsys.readouterr().err
    assert not list(inputs.glob("o*"))


@pytest.mark.parametrize(
    "words",
    [
        "library cell.toml -o o.h5",
        "design cell.toml -o o.h5",
        "study cell.toml -o o",
        "psf lens.h5 --config cell.toml -o o.h5",
        "codesign cell.toml -o o",
        "evaluate optics lens.h5 --config cell.toml -o o",
    ],
)
def test_long_work_is_not_begun_from_an_empty_file(inputs, capsys, words):
    """A file cut to nothing, a device; a comment alone asks for the defaults."""
    for text in ("", " \n\n", "\ufeff\n"):
        (inputs / "cell.toml").write_text(text)
        assert main(words.split()) == BAD_INPUT
        assert "cell.toml: empty; need settings" in capsys.readouterr().err
    assert main(words.replace("cell.toml", "/dev/null").split()) == BAD_INPUT
    assert "/dev/null: empty; need settings" in capsys.readouterr().err
    assert not list(inputs.glob("o*"))


def test_a_comment_asks_for_the_defaults(tmp_path):
    (tmp_path / "cell.toml").write_text("# the default cell\n")
    assert config.load(tmp_path / "cell.toml", CellFile, empty=False) == CellFile()


def test_folders_made_above_an_output_go_again_after_a_refusal(
    inputs, monkeypatch, capsys
):
    """What others put there in the meantime stays, and so does a folder that was there
    before.
    """
    monkeypatch.setattr("codesign.commands.codesign._work", lambda *_: 1 / 0)
    (inputs / "kept").mkdir()
    assert main(["codesign", "run.toml", "-o", "kept/new/deep/out"]) == BAD_INPUT
    assert list((inputs / "kept").iterdir()) == []

    def other(*_):
        (inputs / "kept" / "new" / "mine").write_text("x")
        raise FloatingPointError

    monkeypatch.setattr("codesign.commands.codesign._work", other)
    assert main(["codesign", "run.toml", "-o", "kept/new/deep/out"]) == BAD_INPUT
    assert [p.name for p in (inputs / "kept" / "new").iterdir()] == ["mine"]
    assert "not foreseen" in capsys.readouterr().err
