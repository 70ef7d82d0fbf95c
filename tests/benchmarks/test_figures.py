"""Every figure of the pages' tables and sentences comes from a file of
benchmarks/results.
"""

import json

import pytest

from benchmarks import figures


def test_tables_of_the_pages_are_what_the_result_files_say():
    for page, table in figures.tables().items():
        assert table in page.read_text(encoding="utf-8"), (
            f"{page.name}: run python -m benchmarks.figures"
        )


@pytest.mark.parametrize("sentence", figures.SENTENCES)
def test_a_sentence_of_the_limits_says_what_the_result_files_say(sentence):
    assert figures.filled(sentence) in figures.LIMITS.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("value", "form", "written"),
    [
        (0.02409, "2", "0.024"),
        (3.4e-05, "2", "3.4e-5"),
        (6.698, "2", "6.7"),
        (39.72, "3", "39.7"),
        (115.8, "3", "116"),
        (0.0, "1", "0"),
        (0.3921, "ms", "392"),
        (495.5, "GB", "0.5"),
        (0.0003085, "%", "0.03"),
        (0.01644, "rate", "61"),
    ],
)
def test_a_figure_is_written_with_the_digits_asked_for(
    tmp_path, monkeypatch, value, form, written
):
    row = {
        "case": "lens",
        "method": "fit",
        "against": "",
        "goal": "7 of 9",
        "threads": 3,
        "error": value,
    }
    other = row | {"method": "fit, with gradient", "error": -1.0}
    (tmp_path / "made.json").write_text(
        json.dumps({"rows": [row, other]}), encoding="utf-8"
    )
    monkeypatch.setattr(figures, "RESULTS", tmp_path)
    assert (
        figures.filled(f"x {{made; lens & fit & 3 threads; error; {form}}} y")
        == f"x {written} y"
    )
    assert figures.filled("{made; fit, with; (\\d+) of; text}") == "7"
    with pytest.raises(LookupError, match="has 0 rows"):
        figures.filled("{made; mask; error; 2}")
    with pytest.raises(LookupError, match="has 2 rows"):
        figures.filled("{made; lens; error; 2}")
