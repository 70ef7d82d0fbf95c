"""Numeric tests under other arithmetic: ``python tests/arithmetic.py [all | NAME
...]``; no name: a quick selection.

A tolerance that holds on one processor only shows here. Each row of ``ARITHMETIC`` is a
processor that this one can
play by the documented switches of the libraries: OPENBLAS_CORETYPE (numpy's and scipy's
kernels), ATEN_CPU_CAPABILITY,
MKL_CBWR and ONEDNN_MAX_CPU_ISA (torch), NPY_DISABLE_CPU_FEATURES (numpy's loops),
NUMBA_CPU_NAME and
NUMBA_CPU_FEATURES (compiled loops, with a cache of their own), and the number of
threads. ``interpreted`` runs the
loops as they are written (NUMBA_DISABLE_JIT): a place beyond an array is an error
there, as is a number that overflows.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
OLD = {
    "OPENBLAS_CORETYPE": "Nehalem",  # SSE4.2: no fused multiply-add, other block sizes
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",  # the code path of every x86 processor
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
}
AVX2 = {
    "OPENBLAS_CORETYPE": "Haswell",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "",
}
# name: (switches, numpy features left out whose name begins so, threads)
ARITHMETIC = {
    "old": (OLD, ("AVX", "FMA", "X86_V3", "X86_V4", "F16C"), 1),
    "avx2": (AVX2, ("AVX512", "X86_V4"), 1),
    "old-2": (OLD, ("AVX", "FMA", "X86_V3", "X86_V4", "F16C"), 2),
    "own-2": ({}, (), 2),
    "interpreted": ({"NUMBA_DISABLE_JIT": "1"}, (), 1),
}
# Where sums are long or ill-conditioned, and quick: eigenvalues, Fourier sums, windows,
# fits, compiled loops.
QUICK = (
    "tests/metalens/cell",
    "tests/metalens/core/test_legendre.py",
    "tests/metalens/image",
    "tests/metalens/library/test_polynomial.py",
    "tests/metalens/library/test_rational.py",
    "tests/metalens/propagate",
    "tests/metalens/psf/test_psf_stack.py",
    "tests/metalens/rcwa/test_rcwa.py",
    "tests/characterize/model",
    "tests/characterize/measure",
    "tests/layout/pec",
    "tests/layout/study/test_focus.py",
    "tests/codesign/gaze",
    "tests/codesign/optics",
)
# Small tests of compiled loops, 80 s of one processor. Sums modulo 2⁶⁴
# (layout/formats/digest) stay with machine code.
INTERPRETED = (
    "tests/codesign/batches/test_flat.py",
    "tests/codesign/eye/test_renderer.py",
    "tests/codesign/eye/test_shading.py",
    "tests/codesign/optics/test_built.py",
    "tests/layout/drc",
    "tests/layout/formats",
    "tests/layout/pec",
    "tests/metalens/propagate",
)
ALL = tuple(
    f"tests/{folder}" for folder in ("metalens", "characterize", "layout", "codesign")
)


def _without(prefixes: tuple[str, ...]) -> str:
    """The features of this processor that numpy has loops for and that are to be left
    out.
    """
    from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

    return " ".join(
        name
        for name in __cpu_dispatch__
        if name.startswith(prefixes) and __cpu_features__[name]
    )


def environment(name: str) -> dict[str, str]:
    """The environment of a run under the arithmetic ``name``."""
    switches, prefixes, threads = ARITHMETIC[name]
    kind = switches.get("NUMBA_CPU_NAME", "own")
    own = {
        "NUMBA_CACHE_DIR": str(ROOT / "build" / "arithmetic" / kind),
        "CI": "1",
        "OMP_WAIT_POLICY": "passive",
    }
    own |= {
        key: str(threads)
        for key in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
    }
    features = {"NPY_DISABLE_CPU_FEATURES": _without(prefixes)} if prefixes else {}
    return os.environ | switches | features | own


def main(words: list[str]) -> int:
    """Run pytest once per arithmetic; the worst of their exit codes."""
    names = [w for w in words if w in ARITHMETIC] or (
        list(ARITHMETIC) if "all" in words else ["old", "interpreted"]
    )
    worst = 0
    for name in names:
        sys.stdout.write(f"arithmetic {name}\n")
        sys.stdout.flush()
        folders = INTERPRETED if name == "interpreted" else ALL if words else QUICK
        workers = "auto" if ARITHMETIC[name][2] == 1 else "1"
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-n",
            workers,
            "--dist",
            "loadfile",
            "-m",
            "not slow",
        ]
        done = subprocess.run(
            [*command, *folders], cwd=ROOT, env=environment(name), check=False
        )
        worst = max(worst, done.returncode)
    return worst


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
