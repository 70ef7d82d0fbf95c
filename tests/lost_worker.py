"""A local cluster of two workers, one of which is killed as soon as the first task of a
sweep is done.
"""

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest


@contextlib.contextmanager
def losing_one(folder: Path) -> Iterator[str]:
    """The address of its scheduler; at the end of the block the loss must have
    happened.
    """
    distributed = pytest.importorskip("distributed")
    killed = []
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address=None,
        local_directory=str(folder),
    ) as cluster:

        class Loss(distributed.SchedulerPlugin):
            def transition(self, key, start, finish, *_, **about):
                if finish == "memory" and "_alone" in str(key) and not killed:
                    name = cluster.scheduler.workers[about["worker"]].name
                    killed.append(cluster.workers[name].pid)
                    os.kill(killed[0], signal.SIGKILL)

        cluster.scheduler.add_plugin(Loss())
        yield cluster.scheduler_address
    assert killed
