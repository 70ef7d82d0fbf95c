"""The chain from one file: which stages it asks for, and its settings laid out."""

import json
import sys
from pathlib import Path

import pytest

from metalens.commands import chain, demo
from metalens.commands.chain import ChainFiles
from metalens.commands.design import DesignSettings
from metalens.core import config, transaction
from metalens.core.errors import ConfigError


def _verbs(files):
    return [stage.words[0] for stage in chain.chain_stages(files)]


def test_a_stage_without_its_file_is_left_out(tmp_path):
    for name in ("c", "d", "p", "r"):
        (tmp_path / f"{name}.toml").write_text("")
    text = 'cell = "c.toml"\ndesign = "d.toml"\nprocess = "p.toml"\nbudget = false\n'
    (tmp_path / "chain.toml").write_text(text)
    assert _verbs(chain.load_chain(tmp_path / "chain.toml")) == [
        "library",
        "design",
        "psf",
        "layout",
    ]
    (tmp_path / "chain.toml").write_text(text + 'run = "r.toml"\npsf = "p.toml"\n')
    stages = list(chain.chain_stages(chain.load_chain(tmp_path / "chain.toml")))
    (tmp_path / "chain.toml").write_text(
        text + 'bench_design = "d.toml"\nbench_truth = "r.toml"\n'
    )
    own = list(chain.chain_stages(chain.load_chain(tmp_path / "chain.toml")))
    assert [s.words[0] for s in own[-3:]] == ["design", "capture", "fit"]
    assert "bench_lens.h5" in own[-1].words
    assert stages[-1].words[0] == "codesign"
    assert "--config" in stages[2].words


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('cell = "c.toml"\n', "missing key"),
        (
            'cell = "absent.toml"\ndesign = "c.toml"\nprocess = "c.toml"\n',
            "no such file",
        ),
        (
            'cell = "c.toml"\ndesign = "c.toml"\nprocess = "c.toml"\nbench_design = "c.toml"\n',
            "measures one lens",
        ),
        (
            'cell = "c.toml"\ndesign = "c.toml"\nprocess = "c.toml"\nbench_truth = "c.toml"\n',
            "measures one lens",
        ),
        ('cell = "c.toml"\ndesin = "c.toml"\n', "did you mean 'design'"),
    ],
)
def test_incomplete_chains_are_refused(tmp_path, text, message):
    (tmp_path / "c.toml").write_text("")
    (tmp_path / "chain.toml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        chain.load_chain(tmp_path / "chain.toml")


def test_settings_are_laid_out_under_plain_names_with_the_aperture_put_in(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    source.mkdir()
    target.mkdir()
    (source / "my.toml").write_text(
        'profile = "cubic"\naperture_mm = 1.0\n[cubic]\nstrength_rad = 5.0\n'
    )
    for name in ("c", "p"):
        (source / f"{name}.toml").write_text(f"# {name}\n")
    laid = chain.lay_out_inputs(
        ChainFiles(Path("c.toml"), Path("my.toml"), Path("p.toml")),
        source,
        aperture_mm=0.25,
    )
    laid.write(target)
    assert laid.files == ChainFiles(
        Path("cell.toml"), Path("design.toml"), Path("process.toml")
    )
    made = config.load(target / "design.toml", DesignSettings)
    assert (made.aperture_mm, made.profile, made.cubic.strength_rad) == (
        0.25,
        "cubic",
        5.0,
    )


def laid_out(tmp_path, **texts):
    """Settings of which that of the cell names tables; the folder that they are laid
    out in.
    """
    source, target = tmp_path / "source", tmp_path / "target"
    for folder in (source / "tables", target):
        folder.mkdir(parents=True, exist_ok=True)
    for name, text in ({"c.toml": "", "d.toml": "", "p.toml": ""} | texts).items():
        (source / name).write_text(text)
    chain.lay_out_inputs(
        ChainFiles(Path("c.toml"), Path("d.toml"), Path("p.toml")),
        source,
        aperture_mm=None,
    ).write(target)
    return target


def test_tables_and_maps_that_settings_name_are_laid_out_with_them(tmp_path):
    """Beside or below them, at any depth of the file; what the chain makes, words and
    whole paths are left alone.
    """
    (tmp_path / "mine.csv").write_text("whole path")
    cell = f'a = [{{of = "tables/si.csv"}}, "{tmp_path}/mine.csv"]\n[b]\nn = "SiO2.x"\nk = "table.csv"\n'
    tables = {"table.csv": "1,2\n", "library.h5": "none of the chain's"}
    (tmp_path / "source" / "tables").mkdir(parents=True)
    (tmp_path / "source" / "tables" / "si.csv").write_text("3,4\n")
    target = laid_out(
        tmp_path,
        **{"c.toml": "\ufeff" + cell, "d.toml": 'library = "library.h5"\n'},
        **tables,
    )
    found = sorted(
        p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file()
    )
    assert found == [
        "cell.toml",
        "design.toml",
        "process.toml",
        "table.csv",
        "tables/si.csv",
    ]
    assert (target / "tables" / "si.csv").read_text() == "3,4\n"
    assert (target / "cell.toml").read_text() == cell


def begun(tmp_path, monkeypatch, config=None):
    """A chain that was interrupted at its third stage; the words of all stages that are
    begun from then on.
    """
    seen = []

    def run(words):
        seen.append(words[0])
        sys.stdout.write(json.dumps({"of": words[0]}))
        return 130 if len(seen) == 3 else 0

    monkeypatch.setattr(demo, "run_verb", run)
    monkeypatch.setattr(demo, "_write", lambda folder, outcomes: None)
    with pytest.raises(KeyboardInterrupt):
        demo.run(demo.Options(tmp_path / "out", config=config, quiet=True))
    assert seen == ["library", "design", "psf"]
    seen[:] = ["-"] * 3
    return seen


def test_settings_that_differ_are_refused_at_every_resume(tmp_path, monkeypatch):
    """The first refusal once left the new settings in the folder: the second resume
    went on to a mixture.
    """
    seen = begun(tmp_path, monkeypatch)
    for _ in range(2):
        with pytest.raises(ConfigError, match="begun with other settings"):
            demo.run(
                demo.Options(
                    tmp_path / "out", aperture_mm=0.37, resume=True, quiet=True
                )
            )
    assert len(seen) == 3
    assert demo.run(demo.Options(tmp_path / "out", resume=True, quiet=True)) == 0
    assert seen[3] == "psf"


def test_a_table_that_was_edited_since_is_other_settings(tmp_path, monkeypatch):
    """Curves would be solved for one, the rest of the chain be done with the other."""
    (tmp_path / "table.csv").write_text("1,2\n")
    for name in "dp":
        (tmp_path / f"{name}.toml").write_text("")
    (tmp_path / "c.toml").write_text('n = "table.csv"\n')
    (tmp_path / "chain.toml").write_text(
        'cell = "c.toml"\ndesign = "d.toml"\nprocess = "p.toml"\nbudget = false\n'
    )
    seen = begun(tmp_path, monkeypatch, config=tmp_path / "chain.toml")
    assert (tmp_path / "out.unfinished" / "table.csv").read_text() == "1,2\n"
    again = demo.Options(
        tmp_path / "out", config=tmp_path / "chain.toml", resume=True, quiet=True
    )
    (tmp_path / "table.csv").write_text("1,3\n")
    with pytest.raises(ConfigError, match="begun with other settings"):
        demo.run(again)
    (tmp_path / "table.csv").write_text("1,2\n")
    assert demo.run(again) == 0
    assert seen[3] == "psf"


def test_nothing_of_other_settings_stays_where_no_stage_was_finished(
    tmp_path, monkeypatch
):
    """After a kill in the first stage: a bench that the second chain has not would
    stand in the finished folder.
    """
    for name, more in (
        ("long", 'bench_truth = "b.toml"\nbench_design = "d.toml"\n'),
        ("short", ""),
    ):
        files = "".join(
            f'{key} = "{key[0]}.toml"\n' for key in ("cell", "design", "process")
        )
        (tmp_path / f"{name}.toml").write_text(f"{files}budget = false\n{more}")
    for name, text in (("c", 'n = "table.csv"\n'), ("d", ""), ("p", ""), ("b", "")):
        (tmp_path / f"{name}.toml").write_text(text)
    (tmp_path / "table.csv").write_text("1,2\n")
    begun(tmp_path, monkeypatch, config=tmp_path / "long.toml")
    for name in (demo.OUTCOMES, "process.toml"):
        (tmp_path / "out.unfinished" / name).unlink()
    (tmp_path / "c.toml").write_text("n = 1.5\n")
    assert (
        demo.run(
            demo.Options(
                tmp_path / "out",
                config=tmp_path / "short.toml",
                resume=True,
                quiet=True,
            )
        )
        == 0
    )
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert made == {
        "cell.toml",
        "design.toml",
        "process.toml",
        demo.OUTCOMES,
        transaction.NAME,
    }
