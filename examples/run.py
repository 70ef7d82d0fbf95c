"""``python -m examples.run [NAME ...]``: execute the example notebooks and keep them, with outputs, in build/notebooks.

The notebooks are kept as Python scripts in percent format (jupytext), so that they read and compare as code.
"""

import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

FOLDER = Path(__file__).parent
TARGET = FOLDER.parent / "build" / "notebooks"


def main(names: list[str]) -> int:
    """Run the named notebooks, all of them without a name; the number that failed."""
    TARGET.mkdir(parents=True, exist_ok=True)
    known = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in ("run", "__init__"))
    failed = 0
    for name in names or known:
        start = time.monotonic()
        notebook = jupytext.read(FOLDER / f"{name}.py")
        client = NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": FOLDER}})
        try:
            client.execute()
            word = "ok"
        except CellExecutionError as error:
            word, failed = f"FAILED\n{error}", failed + 1
        nbformat.write(notebook, TARGET / f"{name}.ipynb")
        print(f"{name}: {word} ({time.monotonic() - start:.0f} s)", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
