"""``python -m metalens``: the command line."""

import os
import sys

if not sys.flags.safe_path and sys.path and sys.path[0] in ("", os.getcwd()):
    sys.path.append(sys.path.pop(0))  # a file queue.py in the current folder must not become the module queue

from metalens.cli import main

sys.exit(main())
