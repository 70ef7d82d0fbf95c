"""``python -m metalens``: the command line."""

import contextlib
import os
import sys

if not sys.flags.safe_path and sys.path:
    here = ""  # the current folder may have been removed
    with contextlib.suppress(OSError):
        here = os.getcwd()
    if sys.path[0] in ("", here):
        sys.path.append(
            sys.path.pop(0)
        )  # a file queue.py in the current folder must not become the module queue

from metalens.cli import main

sys.exit(main())
