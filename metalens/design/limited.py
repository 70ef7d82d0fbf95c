"""Foreign files whose reader may crash or eat the memory are read by a child process
that has little to lose.
"""

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Literal

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import StoreError

_MEMORY, _A_BYTE = (
    2 << 30,
    40,
)  # bytes of address space: numpy and scipy take one GB; more for every byte of the file
_SECONDS = 120
_A = {"MATLAB": "a MATLAB", "NPZ": "an NPZ"}
_CHILD = """
import io, resource, sys
kind, memory, seconds = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
sys.path[:] = sys.argv[5:]
resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
import numpy as np
try:
    given = io.BytesIO(sys.stdin.buffer.read())
    if kind == "NPZ":
        held = dict(np.load(given, allow_pickle=False))
    elif b"\\x89HDF\\r\\n\\x1a\\n" in given.getbuffer()[:4096].tobytes():  # MATLAB 7.3
        import h5py
        file = h5py.File(given)
        inside = [k for k in file if isinstance(file.get(k, getlink=True), h5py.HardLink)]
        items = {k: file[k] for k in inside if isinstance(file[k], h5py.Dataset)}
        held = {k: v[...].T for k, v in items.items() if not (v.is_virtual or v.external)}
    else:
        from scipy.io import loadmat
        held = loadmat(given)
    arrays = {k: v for k, v in held.items() if isinstance(v, np.ndarray) and v.dtype.kind in "biufc"}
    out = io.BytesIO()
    np.savez(out, **{k: v for k, v in arrays.items() if not k.startswith("__")})
    sys.stdout.buffer.write(out.getbuffer())
except BaseException as error:
    sys.stderr.write("REFUSED " + type(error).__name__ + ": " + " ".join(str(error).split())[:200])
    raise SystemExit(3)
"""


def read_arrays_in_subprocess(
    path: Path, kind: Literal["MATLAB", "NPZ"]
) -> dict[str, Array]:
    """Numeric arrays of a MATLAB file (4 to 7.3), or of an NPZ file of NumPy, by name.

    Args:
        path: file to read or write.

    Raises:
        StoreError: no such file, damaged, or more than the child may take.
    """
    words = [sys.executable, "-I", "-c", _CHILD, str(path), kind]
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        with open(path, "rb") as file:
            words += [str(_MEMORY + _A_BYTE * path.stat().st_size), str(_SECONDS)]
            words += [entry for entry in sys.path if entry not in ("", os.getcwd())]
            done = subprocess.run(
                words,
                stdin=file,
                capture_output=True,
                cwd="/",
                env=os.environ | threads,
                timeout=_SECONDS,
                check=False,
            )
        if done.returncode:
            told = done.stderr.decode("utf-8", "replace").rpartition("REFUSED ")
            raise StoreError(
                f"{path}: not {_A[kind]} file: {told[2] if told[1] else _death(done.returncode)}"
            )
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as held:
            return {name: held[name] for name in held.files}
    except subprocess.TimeoutExpired:
        raise StoreError(
            f"{path}: not {_A[kind]} file: its reader took more than {_SECONDS} s"
        ) from None
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error.strerror})") from None
    except MemoryError:
        raise StoreError(f"{path}: takes more memory than there is") from None


def _death(status: int) -> str:
    return (
        f"its reader was ended by signal {-status}"
        if status < 0
        else f"its reader ended with {status}"
    )
