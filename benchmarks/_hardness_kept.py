"""What a bench of commands made and the next one needs again: in the user's cache
folder, never in the repository.
"""

import hashlib
import json
import os
import shutil
import sys
from pathlib import Path

TOLD = ".told.json"
_PACKAGES = ("metalens", "layout", "characterize", "codesign")
_ROOT = Path(__file__).parents[1]


def _place() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "metalens-hardness"


def inputs(of: str) -> Path:
    """Folder of the inputs that are made from these sources."""
    return _place() / f"inputs-{of}"


def sources(texts: dict[str, str]) -> str:
    """What inputs and results depend on: the code that makes them and the settings."""
    code = [path for name in _PACKAGES for path in sorted((_ROOT / name).rglob("*.py"))]
    return _short(
        b"".join(hashlib.sha256(path.read_bytes()).digest() for path in code)
        + _bytes(texts)
    )


def results(of: str, verb: str, words: str) -> Path:
    """Folder of the results of a verb."""
    return _place() / f"results-{_short(f'{of} {words}'.encode())}-{verb}"


def modules() -> list[str]:
    """Modules that commands needed."""
    told = [
        json.loads(path.read_text("utf-8"))["modules"]
        for path in _place().glob(f"results-*/{TOLD}")
    ]
    return sorted(set().union(*told)) if told else []


def taken(source: Path, target: Path) -> bool:
    """Copy what an earlier bench kept; False where it kept none."""
    if not source.exists():
        return False
    copied(source, target)
    return True


def put(source: Path, target: Path) -> None:
    """Keep a file or folder for the next bench."""
    part = target.with_name(f"{target.name}.{os.getpid()}")
    part.parent.mkdir(parents=True, exist_ok=True)
    copied(source, part)
    if target.exists():
        shutil.rmtree(part) if part.is_dir() else part.unlink()
    else:
        part.rename(target)


def copied(source: Path, target: Path) -> None:
    """Copy a file or a folder."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy2(source, target)


def _bytes(texts: dict[str, str]) -> bytes:
    return json.dumps(texts, sort_keys=True).encode()


def _short(content: bytes) -> str:
    return hashlib.sha256(content + sys.version.encode()).hexdigest()[:16]
