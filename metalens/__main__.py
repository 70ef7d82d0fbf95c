"""``python -m metalens``: the command line."""

import sys

from metalens.cli import main

sys.exit(main())
