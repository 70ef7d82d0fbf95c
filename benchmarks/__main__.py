"""``python -m benchmarks [TOPIC ...] [--peers]``: print the tables, keep them in benchmarks/results and in the README.

Without a topic all are run but those that take a quarter of an hour or need an extra package (``LONG``).
"""

import importlib
import json
import pkgutil
import platform
import sys
from dataclasses import asdict
from pathlib import Path

import benchmarks
from benchmarks import Row, figures

LONG = ("install", "hardness", "hard_cells", "limits", "plan", "scene_referee")
HEAD = ("case", "method", "threads", "time/ms", "peak/MB", "error", "measured against", "goal")


def main(words: list[str]) -> None:
    peers = "--peers" in words
    folder = Path(__file__).parent
    known = sorted(m.name for m in pkgutil.iter_modules([str(folder)]) if not m.name.startswith("_"))
    for topic in [w for w in words if not w.startswith("-")] or [k for k in known if k not in LONG]:
        module = importlib.import_module(f"benchmarks.{topic}")
        make = getattr(module, "peer_rows" if peers else "rows", None)
        if make is None:
            continue
        rows = make()
        print(f"\n{topic}\n{table(rows)}", flush=True)
        about = {"python": platform.python_version(), "cores": len(__import__("os").sched_getaffinity(0))}
        result = {"machine": about, "rows": [asdict(row) for row in rows]}
        name = f"{topic}_peers.json" if peers else f"{topic}.json"
        (folder / "results" / name).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    figures.write()


def table(rows: list[Row]) -> str:
    """Rows as aligned columns."""
    cells = [HEAD, *(_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(HEAD))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)


def _cells(row: Row) -> tuple[str, ...]:
    blank = "-"
    peak = blank if row.peak_mb != row.peak_mb else f"{row.peak_mb:.0f}"
    error = blank if row.error != row.error else f"{row.error:.2g}"
    time = f"{row.seconds * 1e3:.4g}"
    return (row.case, row.method, str(row.threads), time, peak, error, row.against, row.goal)


if __name__ == "__main__":
    print(f"benchmarks of {Path(benchmarks.__file__).parent.name}, metalens-toolchain")
    main(sys.argv[1:])
