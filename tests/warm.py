"""Compile the loops once, before several workers of the suite would each do it.

``python -m tests.warm`` runs the chain of one small lens where the compiled code of these
sources is not on the disk yet. Compiled code is kept by what the sources hold: their
times are set from their contents, since a fresh checkout gives every file a new one.
"""

import hashlib
import os
import sys
import tempfile
from pathlib import Path

import llvmlite
import numba

ROOT = Path(__file__).parents[1]
PACKAGES = ("metalens", "layout", "characterize", "codesign")
LEAST_SECONDS = 1_000_000_000  # of a file's time, so that it lies in this century


def stamp() -> str:
    """Set the time of every source with compiled loops from its content.

    Returns:
        Digest of all of them, of Python, numba and llvmlite.
    """
    versions = sys.version, numba.__version__, llvmlite.__version__
    total = hashlib.sha256(repr(versions).encode())
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            content = path.read_bytes()
            if b"njit" in content:
                digest = hashlib.sha256(content).digest()
                total.update(digest)
                seconds = LEAST_SECONDS + int.from_bytes(digest[:3], "big")
                if path.stat().st_mtime != seconds:
                    os.utime(path, (seconds, seconds))
    return total.hexdigest()[:16]


def main() -> None:
    """Stamp the sources; compile where no run has left the mark of this digest."""
    digest = stamp()
    if "--digest" in sys.argv:
        sys.stdout.write(digest + "\n")
        return
    cache = Path(os.environ.get("NUMBA_CACHE_DIR", ROOT / "build" / "warm"))
    mark = cache / f"warm-{digest}"
    if mark.exists():
        return
    from tests import small

    with tempfile.TemporaryDirectory() as folder:
        chain = small.Chain(Path(folder))
        for target in small.STAGES:
            _ = chain[target]
    cache.mkdir(parents=True, exist_ok=True)
    mark.touch()


if __name__ == "__main__":
    main()
