"""``python -m examples.run [NAME ...] [--gallery]``: execute the example notebooks and keep them in build/notebooks.

The notebooks are kept as Python scripts in percent format (jupytext), so that they read and compare as code. With
``--gallery`` they are also written to docs/gallery with their pictures, as pages of the documentation site.
"""

import base64
import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError

FOLDER = Path(__file__).parent
TARGET = FOLDER.parent / "build" / "notebooks"
GALLERY = FOLDER.parent / "docs" / "gallery"


def main(words: list[str]) -> int:
    """Run the named notebooks, all of them without a name; the number that failed."""
    names = [word for word in words if not word.startswith("-")]
    TARGET.mkdir(parents=True, exist_ok=True)
    known = sorted(
        path.stem
        for path in FOLDER.glob("*.py")
        if path.stem not in ("run", "__init__")
    )
    failed = 0
    for name in names or known:
        start = time.monotonic()
        notebook = jupytext.read(FOLDER / f"{name}.py", fmt="py:percent")
        client = NotebookClient(
            notebook,
            timeout=600,
            kernel_name="python3",
            resources={"metadata": {"path": FOLDER}},
        )
        try:
            client.execute()
            word = "ok"
        except (CellExecutionError, CellTimeoutError) as error:
            word, failed = f"FAILED\n{error}", failed + 1
        nbformat.write(notebook, TARGET / f"{name}.ipynb")
        if word == "ok" and "--gallery" in words:
            write_page(notebook, name)
        print(f"{name}: {word} ({time.monotonic() - start:.0f} s)", flush=True)
    return failed


def write_page(notebook: nbformat.NotebookNode, name: str) -> None:
    """One page of the site: texts, code that folds, what it printed, and its pictures beside it."""
    GALLERY.mkdir(parents=True, exist_ok=True)
    for old in GALLERY.glob(f"{name}_*.png"):
        old.unlink()
    parts, pictures = [], 0
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        code = "\n".join(
            f"    {line}" for line in f"```python\n{cell.source}\n```".splitlines()
        )
        parts.append(f'??? note "code"\n{code}')
        printed = "".join(
            output.text
            for output in cell.outputs
            if output.output_type == "stream" and output.name == "stdout"
        )
        if printed:
            parts.append(f"```text\n{printed.rstrip()}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                pictures += 1
                (GALLERY / f"{name}_{pictures}.png").write_bytes(
                    base64.b64decode(data["image/png"])
                )
                parts.append(f"![{name}, picture {pictures}]({name}_{pictures}.png)")
    last = f"This page is `examples/{name}.py`, executed by `python -m examples.run {name} --gallery`."
    (GALLERY / f"{name}.md").write_text(
        "\n\n".join([*parts, last]) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
