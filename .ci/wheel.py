"""Whether a wheel holds every file of the packages: ``python .ci/wheel.py WHEEL``."""

import subprocess
import sys
import zipfile

PACKAGES = ("metalens", "layout", "characterize", "codesign")


def main() -> int:
    """0 where nothing is missing, 1 else."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", *PACKAGES], capture_output=True, check=True, text=True
    )
    with zipfile.ZipFile(sys.argv[1]) as wheel:
        held = set(wheel.namelist())
    missing = sorted({name for name in listed.stdout.split("\0") if name} - held)
    for name in missing:
        sys.stderr.write(f"not in the wheel: {name}\n")
    return bool(missing)


if __name__ == "__main__":
    sys.exit(main())
