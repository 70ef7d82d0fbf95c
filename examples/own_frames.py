"""Your own eye frames, read by a run's network and compared with your targets."""

import sys
from pathlib import Path

import numpy as np

from codesign.adapt import retrained_network
from codesign.evaluate import own_frames
from codesign.settings import ExperimentConfig


def mean_errors(run: Path, frames: Path) -> dict[str, float]:
    """Mean error of every target that ``frames/frames.csv`` gives, by name and unit."""
    source = retrained_network.load_retrained(run)  # of codesign or retrain
    table = own_frames.predict_own_frames(source, frames, ExperimentConfig())
    for name, depth_mm in zip(table["file"], table["slip_z_mm"], strict=True):
        print(f"{name}: {depth_mm:.2f} mm from the place of training")
    return {
        name: float(np.nanmean(values))
        for name, values in table.items()
        if "error" in name
    }


if __name__ == "__main__" and Path(sys.argv[-1]).is_dir():
    print(mean_errors(*map(Path, sys.argv[1:])))
