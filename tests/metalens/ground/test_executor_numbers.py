"""Where many tasks go, by counts: processes of a machine, seconds for a cluster, and
when a worker ends.
"""

import contextlib
import os
from types import SimpleNamespace

import pytest

from metalens.ground import executor
from metalens.ground.errors import ConfigError, WorkerError


@pytest.fixture
def pools(monkeypatch):
    """Counts of processes of the pools that are begun; tasks are done here."""
    begun = []

    @contextlib.contextmanager
    def pool(count):
        begun.append(count)
        yield count

    def here(pool, work, common, tasks):
        yield from ((i, work(common, task)) for i, task in enumerate(tasks))

    monkeypatch.setattr(executor, "_pool", pool)
    monkeypatch.setattr(executor, "_here", here)
    return begun


def test_a_machine_is_asked_for_1_to_1024_processes(pools):
    for count in (1, 1024):
        with executor.on(processes=count):
            assert executor.gather(divmod, 17, [5, 3]) == [(3, 2), (5, 2)]
    assert pools == [1, 1024]
    for count in (0, 1025):
        with (
            pytest.raises(ConfigError, match="need 1 to 1024"),
            executor.on(processes=count),
        ):
            pass


def test_there_are_no_more_processes_than_tasks_or_cores(pools, monkeypatch):
    monkeypatch.setattr(executor, "cores", lambda: 4)
    for tasks, asked, count in (
        ([7, 5, 3], None, 3),
        (range(9), None, 4),
        (range(9), 6, 6),
        ([2], 6, 1),
    ):
        assert list(executor.run(str, list(tasks), processes=asked)) == [
            (i, str(t)) for i, t in enumerate(tasks)
        ]
        assert pools.pop() == count
    assert list(executor.run(str, [])) == []
    assert pools == []


def test_cores_are_those_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr(
        os, "sched_getaffinity", {0: {3, 4, 9}, 1: {5}}.get, raising=False
    )
    assert executor.cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert executor.cores() == 6
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert executor.cores() == 1


def test_a_cluster_is_waited_for_ten_seconds(monkeypatch):
    asked = []

    def client(address, *, timeout, set_as_default):
        asked.append((address, timeout, set_as_default))
        raise OSError("nobody there")

    monkeypatch.setattr(
        executor.importlib, "import_module", lambda name: SimpleNamespace(Client=client)
    )
    with (
        pytest.raises(WorkerError, match="no dask scheduler at 'tcp://a:1'"),
        executor.on("tcp://a:1"),
    ):
        pass
    assert asked == [("tcp://a:1", 10, False)]


def test_a_worker_prints_messages_and_ends_within_half_a_second_of_its_parent():
    """What it prints goes where its errors go; it ends with a failure, since nobody
    waits for it.
    """
    moved, waited, ended, begun = [], [], [], []
    parents = iter([77, 77, 1])
    with (
        pytest.MonkeyPatch.context() as patch
    ):  # let go before the test ends: pytest moves handles too
        patch.setattr(os, "dup2", lambda *handles: moved.append(handles))
        patch.setattr(os, "getppid", lambda: next(parents))
        patch.setattr(os, "_exit", ended.append)
        patch.setattr(executor.time, "sleep", waited.append)
        patch.setattr(
            executor.threading,
            "Thread",
            lambda **about: begun.append(about) or SimpleNamespace(start=int),
        )
        executor._settle(77)
        executor._watch(77)
    assert moved == [(2, 1)]
    assert [(one["args"], one["daemon"]) for one in begun] == [((77,), True)]
    assert (waited, ended) == ([0.5, 0.5], [1])
