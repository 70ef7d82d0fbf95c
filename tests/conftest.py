"""Fixtures shared by all tests, the one hypothesis profile, and the seed of a run."""

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from metalens.core import report
from tests import small

# No clock decides a test: no deadline, no complaint of slow data. Every run draws anew;
# a failure prints the line that repeats it.
hypothesis.settings.register_profile(
    "house",
    deadline=None,
    print_blob=True,
    suppress_health_check=[
        hypothesis.HealthCheck.too_slow,
        hypothesis.HealthCheck.function_scoped_fixture,
    ],
)
hypothesis.settings.load_profile("house")


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--draws SEED`` repeats the random draws of a run."""
    parser.addoption("--draws", type=int, default=None, help="seed of the rng fixture")


def _seed(config: pytest.Config) -> int:
    """Of this run: the same for all its workers."""
    given = config.getoption("--draws")
    if given is None and hasattr(config, "workerinput"):
        given = int(config.workerinput["testrunuid"][:7], 16)
    if given is None:
        given = int.from_bytes(os.urandom(3), "big")
    config.option.draws = given
    return int(given)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers of a test: by the seed of the run and the name of the test.

    The report of a failing test names the seed.
    """
    seed = _seed(request.config)
    request.node.add_report_section("setup", "draws", f"repeat with --draws {seed}")
    name = list(request.node.nodeid.encode())
    return np.random.default_rng([seed, *name])


def folder_of_run(factory: pytest.TempPathFactory) -> Path:
    """The temporary folder that all workers of a run share."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def small_chain(tmp_path_factory: pytest.TempPathFactory) -> small.Chain:
    """Files of one small lens without symmetry, one set for all workers; each is made
    when first asked for.
    """
    return small.Chain(folder_of_run(tmp_path_factory) / "small")


@pytest.fixture(scope="session", autouse=True)
def cache_of_the_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What the code keeps for later runs goes to a folder of this run, one for all its
    workers.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder_of_run(tmp_path_factory) / "cache"))
        yield


@pytest.fixture(scope="session", autouse=True)
def pixels_of_pictures() -> Iterator[int]:
    """Those of an inch as users have them. In tests a quarter of that: two thirds of
    the time, the same drawing.
    """
    usual = report.figure_png.__kwdefaults__
    fine = usual["dpi"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(usual, "dpi", fine // 4)
        yield fine


@pytest.fixture
def fine_pictures(pixels_of_pictures: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures as users have them, for a test that asks how large they are."""
    monkeypatch.setitem(report.figure_png.__kwdefaults__, "dpi", pixels_of_pictures)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference material beside the checkout; tests that need it are
    skipped where it is absent.
    """
    folder = Path(__file__).parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("reference material is not beside the checkout")
    return folder
