"""``python -m benchmarks [TOPIC ...] [--peers]``: print the tables, keep them in
benchmarks/results and in the README.

Beneath each table stand its times and errors over those that were stored before.

Without a topic all are run but those that take a quarter of an hour, or need an extra
package or a GPU (``LONG``).
"""

import argparse
import importlib
import json
import re
import sys
import traceback
from dataclasses import asdict
from pathlib import Path

import benchmarks
from benchmarks import Row, figures
from benchmarks._stored import compared, machine

LONG = ("engines", "hard_cells", "limits", "scene_referee")
HEAD = (
    "case",
    "method",
    "threads",
    "time/ms",
    "peak/MB",
    "error",
    "measured against",
    "goal",
)


def main(words: list[str]) -> int:
    """Run topics; one that fails is told and the others go on. 0: all done, 1: some
    failed.

    Raises:
        SystemExit: unknown words.
    """
    asked = _parser().parse_args(words)
    failed = [
        topic
        for topic in asked.topics or sorted(_topics().keys() - set(LONG))
        if not _done(topic, asked.peers)
    ]
    figures.write()
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "topics",
        nargs="*",
        metavar="TOPIC",
        choices=list(_topics()),
        help=", ".join(_topics()),
    )
    parser.add_argument(
        "--peers",
        action="store_true",
        help="beside other projects, where these are installed",
    )
    return parser


def _topics() -> dict[str, str]:
    """{topic: module} of those with ``rows`` or ``peer_rows``, not imported for it."""
    folder = Path(__file__).parent
    made = re.compile(r"^def (peer_)?rows\(", re.M)
    return {
        path.stem: f"benchmarks.{path.parent.name}.{path.stem}"
        for path in sorted(folder.glob("*/[!_]*.py"))
        if made.search(path.read_text(encoding="utf-8"))
    }


def _done(topic: str, peers: bool) -> bool:
    """Run a topic and keep its rows; one without rows of this sort is passed over."""
    module = importlib.import_module(_topics()[topic])
    make = getattr(module, "peer_rows" if peers else "rows", None)
    if make is None:
        return True
    rows: list[Row] = []
    try:
        for row in make():  # a topic whose rows take minutes gives them one by one
            rows.append(row)
            print(
                f"{topic}: {row.case}, {row.method}: {row.seconds * 1e3:.4g} ms",
                file=sys.stderr,
                flush=True,
            )
    except Exception:  # noqa: BLE001 whatever it is, the other topics go on
        print(f"\n{topic}", file=sys.stderr)
        traceback.print_exc()
        return False
    print(f"\n{topic}\n{table(rows)}", flush=True)
    path = figures.RESULTS / (f"{topic}_peers.json" if peers else f"{topic}.json")
    print(f"\n{compared(path, rows)}", flush=True)
    result = {"machine": machine(), "rows": [asdict(row) for row in rows]}
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return True


def table(rows: list[Row]) -> str:
    """Rows as aligned columns."""
    cells = [HEAD, *(_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(HEAD))]
    return "\n".join(
        "  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip()
        for line in cells
    )


def _cells(row: Row) -> tuple[str, ...]:
    blank = "-"
    peak = blank if row.peak_mb != row.peak_mb else f"{row.peak_mb:.0f}"
    error = blank if row.error != row.error else f"{row.error:.2g}"
    time = f"{row.seconds * 1e3:.4g}"
    return (
        row.case,
        row.method,
        str(row.threads),
        time,
        peak,
        error,
        row.against,
        row.goal,
    )


if __name__ == "__main__":
    print(f"benchmarks of {Path(benchmarks.__file__).parent.name}, metalens-toolchain")
    sys.exit(main(sys.argv[1:]))
