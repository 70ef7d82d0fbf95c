"""``python -m benchmarks.figures``: tables of the pages, written from result files.

figures.md holds a table for each page with a reference in the place of each figure,
``{file; words; key; digits}``: the file of benchmarks/results, words that each stand in
the row's case, method, goal or "N threads" (one row must fit), the column (or an
expression that finds the figure in those words), and its form: a count of digits,
``ms``, ``GB`` (of a column in MB), ``%``, ``rate`` (one over it) or ``text``.
"""

import json
import re
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
TEMPLATE, RESULTS = HERE / "figures.md", HERE / "results"
LIMITS = ROOT / "docs" / "limits.md"
SENTENCES = (  # of docs/limits.md
    "{characterize; fit & rms; seconds; 2} s where 8 s were asked",
    "{psf; 1 mm free-form & windowed 1e-4; (\\d+)x textbook; 3} times as fast as the angular spectrum",
    "{psf_wide; 384 um & windowed 1e-4; (\\S+)x textbook; 2} times in windows as wide as a sensor",
    "{modal; tolerance 0.0001; seconds; ms} ms in the mean",
    "{library; 200 x 11; seconds; 2} s where 60 s were asked",
    "{codesign; 9.7 MMACs, true image & lens fixed; seconds; rate} frames/s with a fixed lens and "
    "{codesign; 9.7 MMACs, true image & lens and pitch moving; seconds; rate} with a moving one",
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


def tables() -> dict[Path, str]:
    """Table of each page, with the figures that the result files hold now."""
    parts = re.split(r"^# (\S+)\n+", TEMPLATE.read_text(encoding="utf-8"), flags=re.M)
    return {
        ROOT / page: filled(text).strip("\n")
        for page, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def write() -> None:
    """Put every table in the place of the one with the same head in its page."""
    for page, table in tables().items():
        text = page.read_text(encoding="utf-8")
        head = table.splitlines()[0]
        old = re.search(rf"^{re.escape(head)}$.*?(?=\n\n)", text, re.M | re.S)
        if not old:
            raise LookupError(f"{page.name} has no table that begins with {head!r}")
        page.write_text(text.replace(old[0], table), encoding="utf-8")


if __name__ == "__main__":
    write()
