"""``python -m benchmarks.figures``: the table of the README, written anew from the
result files.

figures.md holds the table with a reference in the place of each figure, ``{file; words;
key; digits}``: the file of
benchmarks/results, words that each appear in the row's case, method, goal or "N
threads" (the row must be the only
one), the column (or an expression that finds the figure in those words), and how it is
written: a count of digits,
``ms``, ``GB`` (of a column in MB), ``%``, ``rate`` (one over it) or ``text``.
"""

import json
import re
from pathlib import Path

HERE = Path(__file__).parent
README, TEMPLATE, RESULTS = (
    HERE.parent / "README.md",
    HERE / "figures.md",
    HERE / "results",
)
SENTENCES = (  # of the README's text, beside its table
    "{characterize_study; peak 8000 e & Cramér-Rao; error; 3} times the\nCramér-Rao bound",
    "| the fit of a 1 mm lens in 8 s | {characterize; fit & rms; seconds; 2} s |",
    "as fast as the angular spectrum | {psf; 1 mm free-form & windowed 1e-4; (\\d+)x textbook; 3} times |",
    "as wide as a sensor, a hundred times | {psf_wide; 384 um & windowed 1e-4; (\\S+)x textbook; 2} times |",
    "| a round pillar by the modal method to 1e-4 in 50 ms | {modal; tolerance 0.0001; seconds; ms} ms,",
    "of 22 000 entries in 60 s | {library; 200 x 11; seconds; 2} s (",
    "150 frames/s (earlier image model) | {codesign; 9.7 MMACs, true image & lens fixed; seconds; rate} at 9.7 MMACs, "
    "{codesign; 9.7 MMACs, true image & lens and pitch moving; seconds; rate} where the lens moves (",
)
REFERENCE = re.compile(r"\{([^;{}]+); ([^;{}]+); ([^;{}]+); ([^;{}]+)\}")


def filled(text: str) -> str:
    """``text`` with the figure in the place of each reference; LookupError names a
    reference that finds none or two.
    """
    return REFERENCE.sub(lambda found: _figure(*found.groups()), text)


def _figure(file: str, words: str, key: str, form: str) -> str:
    rows = json.loads((RESULTS / f"{file}.json").read_text(encoding="utf-8"))["rows"]
    fitting = [
        row for row in rows if all(word in _words(row) for word in words.split(" & "))
    ]
    fitting = _exact(fitting, words)
    if len(fitting) != 1:
        raise LookupError(
            f"{file}.json has {len(fitting)} rows for {words!r}; benchmarks/figures.md needs one"
        )
    row = fitting[0]
    if key in row:
        return _written(float(row[key]), form)
    found = re.search(key, _words(row))
    if not found:
        raise LookupError(f"{file}.json: no {key!r} in the row {_words(row)!r}")
    return found[1] if form == "text" else _written(float(found[1]), form)


def _words(row: dict[str, object]) -> str:
    return (
        " | ".join(str(row[key]) for key in ("case", "method", "against", "goal"))
        + f" | {row['threads']} threads"
    )


def _exact(rows: list[dict[str, object]], words: str) -> list[dict[str, object]]:
    """Of several rows the one whose method or case is one of the words whole: ``fit``
    beside ``fit, with gradient``.
    """
    whole = [row for row in rows if row["method"] in words.split(" & ")]
    return whole if len(rows) > 1 and whole else rows


def _written(value: float, form: str) -> str:
    scale = {"ms": 1e3, "GB": 1e-3, "%": 100.0}.get(form, 1.0)
    value = 1 / value if form == "rate" else value * scale
    if form in ("ms", "rate"):
        return f"{value:.0f}"
    if form in ("GB", "%"):
        return f"{value:.1f}" if form == "GB" else f"{value:.1g}"
    digits = int(form)
    if value == 0:
        return "0"
    if 1e-2 <= abs(value) < 10**digits:
        written = f"{value:#.{digits}g}" if digits > 1 else f"{value:.1g}"
        return written.rstrip(".")
    if abs(value) >= 10**digits:
        return f"{value:.0f}"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(power)}"


def table() -> str:
    """The README's table as the result files have it now."""
    return filled(TEMPLATE.read_text(encoding="utf-8")).rstrip("\n")


def write() -> None:
    """Put the table in the place of the README's."""
    text = README.read_text(encoding="utf-8")
    old = re.search(r"^\| job \| time .*?(?=\n\n)", text, re.M | re.S)
    if not old:
        raise LookupError("README.md has no table that begins with '| job | time'")
    README.write_text(text.replace(old[0], table()), encoding="utf-8")


if __name__ == "__main__":
    write()
