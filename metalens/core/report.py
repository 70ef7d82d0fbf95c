"""What a command shows: results as tables or JSON, progress, and self-contained pages."""

import base64
import contextlib
import io
import itertools
import json
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from metalens import __version__
from metalens.core.errors import OutputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture with a caption that says what to see in it.

    png: the file's bytes; see :func:`figure_png`.
    """

    png: bytes
    caption: str
    wide: bool = False

    @property
    def source(self) -> str:
        """The picture as a data address, so that the page works offline."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text or numbers under a head.

    head: titles of the columns.
    rows: values, written by :func:`in_figures`.
    caption: text above the table; empty for none.
    digits: significant digits of numbers.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    digits: int = 4

    @property
    def cells(self) -> list[list[str]]:
        """Rows as text, numbers with ``digits`` significant digits."""
        return [[in_figures(value, self.digits) for value in row] for row in self.rows]

    @property
    def text(self) -> str:
        """Caption, head and rows as lines of text, each column as wide as its widest
        cell.

        >>> print(Table(("lens", "axial / mm"), [("a long name", 0.41), ("b", None)], "Read.").text)
        Read.
        lens         axial / mm
        a long name  0.41
        b            –
        """
        rows = align_columns([list(self.head), *self.cells])
        return "\n".join([self.caption, *rows] if self.caption else rows)


@dataclass(frozen=True, slots=True)
class Section:
    """A titled part of the report; ``text`` holds plain paragraphs separated by blank
    lines.
    """

    title: str
    text: str = ""
    items: Sequence[Figure | Table] = ()

    @property
    def paragraphs(self) -> list[str]:
        """The text split at blank lines."""
        return [part.strip() for part in self.text.split("\n\n") if part.strip()]


@dataclass(frozen=True, slots=True)
class KeyFigure:
    """A number at the top of the page; ``good`` colours it (None: neutral)."""

    label: str
    value: str
    good: bool | None = None


UNITS = {
    "um": "µm",
    "nm": "nm",
    "mm": "mm",
    "rad": "rad",
    "deg": "deg",
    "s": "s",
    "seconds": "s",
    "e": "electrons",
    "px": "px",
    "mb": "MB",
    "waves": "waves",
    "um2": "µm²",
    "rad2": "rad²",
    "e2": "electrons²",
    "percent": "%",
    "mmacs": "million MACs",
}


LABELS = {
    "steepest": "steepest phase gradient / k",
    "sampled_aperture": "NA sampled by the lattice",
    "focuses": "the phase forms a focus",
    "focus_passed": "focus at the image point",
    "turns": "phase coverage / turns",
    "entry_error": "rms error of t of the meta-atoms",
    "proxy_phase_error_rad": "fit error of the phase / rad",
    "proxy_transmission_error": "fit error of |t|",
}


def in_words(key: str) -> str:
    """A key of a result in words, with its unit after a slash.

    >>> in_words("max_phase_error_rad")
    'max phase error / rad'
    >>> [in_words(key) for key in ("mtf50_x_per_um", "depth_response_mm_per_mm")]
    ['mtf50 x / (1/µm)', 'depth response / (mm/mm)']
    """
    if key in LABELS:
        return LABELS[key]
    *parts, last = key.split("_")
    unit = UNITS.get(last, "") if parts else ""
    if unit and parts[-1] == "per":
        numerator = UNITS.get(parts[-2], "") if len(parts) > 2 else ""
        unit = f"({numerator or 1}/{unit})"
        parts = parts[: -2 if numerator else -1]
    return f"{' '.join(parts)} / {unit}" if unit else key.replace("_", " ")


def in_figures(value: Any, digits: int = 4) -> str:
    """A value as text: ``digits`` significant digits, yes and no, 0 for rounding errors.

    >>> [in_figures(v) for v in (0.123456, 19553.2, 7.2e-15, True, None, "air", float("nan"))]
    ['0.1235', '19550', '0', 'yes', '–', 'air', 'nan']
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        rounded = f"{value:.{digits}g}"
        if 10**digits <= abs(value) < 1e7:
            return f"{float(rounded):.0f}"
        # what is smaller in um, rad, shares or electrons is rounding
        return "0" if abs(value) < 1e-12 else rounded
    return str(value)


def figure_png(figure: "Canvas", *, dpi: int = 220) -> bytes:
    """PNG bytes of a matplotlib figure, equal for equal drawings.

    Two pixels of the file stand for one of the page, for dense screens and print.

    Args:
        figure: that is drawn.
        dpi: dots per inch.
    """
    buffer = io.BytesIO()
    figure.savefig(
        buffer,
        format="png",
        dpi=dpi,
        bbox_inches="tight",
        metadata={"Software": "metalens"},
    )
    return buffer.getvalue()


def make_figure(
    rows: int = 1,
    columns: int = 1,
    *,
    size: tuple[float, float] = (8.0, 3.4),
    **options: Any,
) -> Any:
    """(figure, axes) of matplotlib in the style of the reports, drawn without a
    display.

    Args:
        rows: panels along a column.
        columns: panels along a row.
        size: width and height, inches.
        options: of ``Figure.subplots``.
    """
    import matplotlib
    from cycler import cycler
    from matplotlib.figure import Figure as Canvas

    style: dict[Any, Any] = {
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.alpha": 0.25,
        "axes.titlesize": 10,
        "axes.titleweight": "bold",
        "figure.facecolor": "white",
        "image.cmap": "magma",
        "axes.prop_cycle": cycler(
            color=["#1f6feb", "#d1495b", "#2a9d8f", "#e9a23b", "#6d597a", "#444"]
        ),
    }
    with matplotlib.rc_context(style):
        figure = Canvas(figsize=size, layout="constrained")
        return figure, figure.subplots(rows, columns, **options)


def write_report(
    path: str | Path,
    title: str,
    sections: Sequence[Section],
    *,
    lead: str = "",
    key_figures: Sequence[KeyFigure] = (),
) -> None:
    """Write an HTML page: title, one lead paragraph, key figures, then the sections
    with a contents list.

    Args:
        path: of the page.
        title: of the page.
        sections: in their order.
        lead: first paragraph.
        key_figures: numbers at the top.

    Raises:
        OSError: the target cannot be written.
    """
    from jinja2 import Environment

    from metalens.core import store

    source = (
        resources.files("metalens")
        .joinpath("data/report.html")
        .read_text(encoding="utf-8")
    )
    template = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True
    ).from_string(source)
    kinds = {Figure: "figure", Table: "table"}
    page = template.render(
        title=title,
        lead=lead,
        key_figures=key_figures,
        sections=sections,
        version=__version__,
        kind_of=lambda item: kinds[type(item)],
    )
    store.write_text(path, page)


def format_summary(values: Mapping[str, Any], indent: str = "  ") -> list[str]:
    r"""Lines of text for a result: label and value; inner mappings follow, indented.

    Args:
        values: numbers, texts, lists and mappings by key; keys end in their unit.
        indent: blanks before every line.

    >>> values = {"fwhm_um": 1.25, "focus": [{"ok": True}, {"ok": False}]}
    >>> print("\n".join(format_summary(values)))
      fwhm / µm  1.25
      focus
        ok       yes  no
    """
    return [indent + line for line in align_columns(list(summary_rows(values)))]


def summary_rows(
    values: Mapping[str, Any] | Sequence[Mapping[str, Any]], level: int = 0
) -> Iterator[list[str]]:
    """Rows of a result as text: label and value; inner mappings follow, indented.

    Several results of the same keys stand side by side, a column for each.

    Args:
        values: a result, or several of the same keys.
        level: steps by which labels are indented.
    """
    entries = [values] if isinstance(values, Mapping) else values
    inner = []
    for key, value in entries[0].items():
        if _is_nested(value):
            inner.append(key)
            continue
        shown = (_list_text(entry.get(key)) for entry in entries)
        yield ["  " * level + in_words(key), *shown]
    for key in inner:
        parts = [entry.get(key) or {} for entry in entries]
        for group in [parts] if isinstance(parts[0], Mapping) else filter(None, parts):
            yield ["  " * level + in_words(key)]
            yield from summary_rows(group, level + 1)


def summary_table(values: Mapping[str, Any], caption: str = "") -> Table:
    """A result as a table of a page, by :func:`summary_rows`.

    Args:
        values: a result.
        caption: below the table.
    """
    rows = [
        [label.replace("  ", "\u2003"), *shown]
        for label, *shown in summary_rows(values)
    ]
    return Table(("quantity", "value"), rows, caption)


def align_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of text of ``rows`` of cells, each column as wide as its widest cell.

    The last cell of a row takes no part in the width of its column.
    """
    columns = itertools.zip_longest(*(row[:-1] for row in rows), fillvalue="")
    widths = [max(map(len, column)) for column in columns]
    return [
        "  ".join([*map(str.ljust, row[:-1], widths), row[-1]]).rstrip() for row in rows
    ]


def finite_or_none(value: Any) -> Any:
    """A value for JSON: None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {name: finite_or_none(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _is_nested(value: Any) -> bool:
    """Whether a value is a mapping, or a list of mappings."""
    if isinstance(value, list | tuple):
        return bool(value) and all(isinstance(entry, Mapping) for entry in value)
    return isinstance(value, Mapping) and bool(value)


def _list_text(value: Any) -> str:
    """One line for a value; a long list of numbers gives its length and range."""
    if not isinstance(value, list | tuple):
        return in_figures(value).replace("\n", " ")
    numbers = [v for v in value if isinstance(v, int | float) and math.isfinite(v)]
    if len(value) > 6 and len(numbers) == len(value):
        limits = in_figures(min(numbers)), in_figures(max(numbers))
        return f"{len(value)} values, {limits[0]} to {limits[1]}"
    return ", ".join(_list_text(entry) for entry in value[:6]) + (
        ", ..." if len(value) > 6 else ""
    )


def flush_output(text: str = "") -> None:
    """Write to standard output and flush it; a closed pipe (``| head``) is no error.

    Args:
        text: what is printed.

    Raises:
        OutputError: it cannot be written otherwise, as to a full disk.
    """
    if sys.stdout is None:  # closed
        return
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        silence_output()
    except OSError as error:
        silence_output()
        raise OutputError(f"standard output: {error.strerror}") from error


def silence_output() -> None:
    """Discard all further standard output, buffered text included."""
    null_device = os.open(os.devnull, os.O_WRONLY)
    with contextlib.suppress(OSError, ValueError):  # standard output without a file
        os.dup2(null_device, sys.stdout.fileno())
    os.close(null_device)


@dataclass(frozen=True, slots=True)
class CommandConsole:
    """Standard output of one command.

    quiet: only errors are shown.
    json: results as one JSON object on standard output; progress is silent.
    """

    quiet: bool = False
    json: bool = False

    def say(self, text: str) -> None:
        """Print one line, unless quiet or with --json."""
        if not (self.quiet or self.json):
            flush_output(text + "\n")

    def report(
        self,
        title: str,
        values: Mapping[str, Any],
        *,
        notes: Iterable[str] = (),
        failures: Iterable[str] = (),
    ) -> int:
        """Show the outcome of a command: JSON with --json, else a table of it.

        Args:
            title: first line for a person.
            values: the result; see :func:`format_summary`.
            notes: sentences that explain the result, added to it; empty ones are left
                out.
            failures: checks that the result failed, as sentences; empty ones are none.

        Returns:
            The exit status of the command: 1 with a failure, else 0.
        """
        sentences = [note.strip() for note in notes if note]
        lines = [title, *format_summary(values), *(f"  {s}" for s in sentences)]
        text = "\n".join(lines)
        return self.judged({**values, "notes": sentences}, text, failures)

    def result(self, values: dict[str, Any], text: str) -> None:
        """Print the outcome: ``values`` as JSON with --json, else ``text``.

        In JSON None stands for numbers that are not finite.
        """
        if self.json:
            flush_output(
                json.dumps(finite_or_none(values), indent=1, default=float) + "\n"
            )
        else:
            self.say(text)

    def judged(self, values: dict[str, Any], text: str, failures: Iterable[str]) -> int:
        """Print the outcome with the checks that it failed, and return the exit status:
        1 with any failure, else 0.

        Args:
            values: the result; ``failures`` is added to them.
            text: the result for a person; a line per failure is added.
            failures: sentences; empty ones are none.
        """
        failed = [failure for failure in failures if failure]
        self.result(
            values | {"failures": failed},
            "\n".join([text, *(f"  FAILED: {failure}" for failure in failed)]),
        )
        return 1 if failed else 0

    def track(self, items: Iterable[Item], *, total: int, label: str) -> Iterator[Item]:
        """Yield ``items`` while printing progress, rate and remaining time every 5 s.

        Args:
            items: that are passed through.
            total: how many there are.
            label: of the progress.
        """
        start = last_shown = time.monotonic()
        for done, item in enumerate(items, 1):
            yield item
            now = time.monotonic()
            if now - last_shown > 5 or (done == total and now - start > 2):
                rate = done / (now - start)
                left = (total - done) / rate
                self.say(f"{label}: {done}/{total}, {rate:.3g}/s, {left:.0f} s left")
                last_shown = now
