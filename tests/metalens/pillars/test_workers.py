"""Workers: what comes back is what was computed, refusals keep their class, a death is
an error with its cause.
"""

import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Incidence, Response
from metalens.cell.record import Cell, Index
from metalens.core import executor
from metalens.core.errors import MaterialError, WorkerError
from metalens.pillars import engines, workers

CELL = Cell(0.30, 0.7, Index(3.6))
TASK = workers.points_task(
    CELL, Incidence(0.85), [0.1, 0.15], tolerance=5e-2, engine="rcwa"
)


def test_what_comes_back_is_what_was_computed():
    ((index, result),) = workers.run_tasks([TASK])
    assert index == 0
    exact = [rcwa.solve(CELL, d, 0.85, tolerance=5e-2) for d in (0.1, 0.15)]
    assert result["diameter_um"] == [0.1, 0.15]
    for (re, im), response in zip(result["t"], exact, strict=True):
        assert complex(re, im) == pytest.approx(
            response.t, abs=1e-12
        )  # another number of BLAS threads
    assert result["error"] == pytest.approx(
        [response.t_error for response in exact], rel=1e-6
    )


def test_the_same_bits_from_any_number_of_workers():
    tasks = [
        workers.points_task(
            CELL, Incidence(0.85), [0.05 + 0.02 * i], tolerance=0.1, engine="rcwa"
        )
        for i in range(5)
    ]
    found = dict(workers.run_tasks(tasks, processes=2))
    assert sorted(found) == [0, 1, 2, 3, 4]
    assert [found[i]["diameter_um"][0] for i in range(5)] == [
        0.05 + 0.02 * i for i in range(5)
    ]
    assert found == dict(workers.run_tasks(tasks, processes=1))


def test_refusals_keep_their_class():
    unknown = workers.points_task(
        Cell(0.3, 0.7, "a-Sj"), Incidence(0.85), [0.1], tolerance=0.1, engine="rcwa"
    )
    with pytest.raises(MaterialError, match="did you mean 'a-Si'"):
        list(workers.run_tasks([TASK, unknown]))


def test_a_worker_that_dies_is_told_with_its_cause():
    with pytest.raises(WorkerError, match=r"ended early.*SIGKILL"):
        list(executor.run_parallel(signal.raise_signal, [signal.SIGKILL]))


def test_a_worker_looks_after_whoever_started_it_and_ends_with_him():
    """In a process of its own, whose third look is its last: with its parent alive it
    comes to that, else it ends.
    """

    def ended(parent):
        child = os.fork()
        if child == 0:
            looks = iter(range(2))
            time.sleep = lambda _: next(looks, None) is None and os._exit(7)
            executor._watch(parent)
            os._exit(9)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    assert ended(os.getpid()) == 7
    assert ended(os.getppid()) == 1  # who started it is no longer its parent


def test_nothing_is_imported_from_the_current_folder_and_prints_are_no_results(
    tmp_path,
):
    """Files that bear the names of modules lie where the command runs; the caller's
    script has no main guard.
    """
    for name in ("queue", "scipy", "subprocess", "json", "multiprocessing"):
        (tmp_path / f"{name}.py").write_text(
            "open('executed', 'w').write(__name__)\nprint('hi')\n"
        )
    (tmp_path / "there").mkdir()
    script = tmp_path / "there" / "script.py"
    script.write_text(
        textwrap.dedent("""
            import os, sys
            from metalens.core import executor
            print(dict(executor.run_parallel(os.path.basename, ["a/b", "c/d"], processes=2)))
            print(dict(executor.run_parallel(print, ["stray"], processes=1)))
        """)
    )
    done = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.splitlines() == ["{0: 'b', 1: 'd'}", "{0: None}"], done.stderr
    assert "stray" in done.stderr
    words = [sys.executable, "-m", "metalens", "library", "cell.toml"]
    told = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert told.returncode == 2
    assert "no such file" in told.stderr
    assert not (tmp_path / "executed").exists()


def test_the_solves_that_choose_a_mesh_are_nodes_of_the_curve(monkeypatch):
    """A curve pays for its nodes and for the two probes that a coarser mesh failed, no
    more.
    """
    asked = []

    def levels(cell, light, largest_um, tolerance):
        def level(name, met):
            def at(diameter_um):
                asked.append((name, diameter_um))
                return Response(
                    0.9 + 0.2j * diameter_um, 0.1 + 0j, 1e-5, 9, 1.0, "modal", met, name
                )

            return at

        return [level("coarse", False), level("fine", True), level("finest", True)]

    monkeypatch.setattr(engines, "_modal_levels", levels)
    found = workers.run_task(
        workers.curves_task(
            CELL,
            [engines.Incidence(0.85)],
            (0.07, 0.23),
            tolerance=1e-3,
            engine="modal",
        )
    )
    failed, nodes = (
        [d for name, d in asked if name == "coarse"],
        [d for name, d in asked if name != "coarse"],
    )
    assert len(failed) == 2
    assert len(nodes) == len(set(nodes))
    assert set(nodes) == set(found["diameter_um"])
    assert {name for name, _ in asked} == {"coarse", "fine"}


@pytest.mark.parametrize("finer_error", [3e-5, 5e-3])
def test_beside_a_resonance_alone_the_next_mesh_takes_over(monkeypatch, finer_error):
    """The largest probe fails on the coarse mesh: from there the finer one counts,
    where it is the better.
    """
    edge, bar = 0.21, 1e-3

    def levels(cell, light, largest_um, tolerance):
        def coarse(diameter_um):
            error = bar if diameter_um > edge else 1e-5
            return Response(
                0.9 + 0j, 0.1 + 0j, error, 9, 1.0, "modal", error <= tolerance, "coarse"
            )

        def fine(diameter_um):
            assert diameter_um > edge
            return Response(
                0.9 + 0j,
                0.1 + 0j,
                finer_error,
                9,
                1.0,
                "modal",
                finer_error <= tolerance,
                "fine",
            )

        return [coarse, fine]

    monkeypatch.setattr(engines, "_modal_levels", levels)
    at = engines.solver_at_fixed_discretization(
        CELL, engines.Incidence(0.85), (0.07, 0.23), tolerance=5e-4, engine="modal"
    )
    assert (at(0.12).reason, at(0.12).t_error) == ("coarse", 1e-5)
    assert at(0.22).t_error == min(bar, finer_error)
    assert at(0.22).reason == ("fine" if finer_error < bar else "coarse")


def test_lights_of_one_direction_take_the_mesh_that_both_need(monkeypatch):
    """Light p needs the third mesh: s is never asked on it for less than its own curve,
    and has it too.
    """
    asked, needs = [], {"s": 1, "p": 2}

    def levels(cell, light, largest_um, tolerance):
        def level(number):
            def at(diameter_um):
                asked.append((light.polarization, number))
                met = number >= needs[light.polarization]
                return Response(
                    0.9 + 0.2j * diameter_um,
                    0.1 + 0j,
                    1e-5,
                    9,
                    1.0,
                    "modal",
                    met,
                    str(number),
                )

            return at

        return [level(number) for number in range(4)]

    monkeypatch.setattr(engines, "_modal_levels", levels)
    lights = [Incidence(0.85, 0.2, "s"), Incidence(0.85, 0.2, "p")]
    s, p = engines.solvers_at_common_discretization(
        CELL, lights, (0.07, 0.23), tolerance=5e-4, engine="modal"
    )
    assert [asked.count(("s", number)) for number in range(4)] == [2, 3, 3, 0]
    assert [asked.count(("p", number)) for number in range(4)] == [
        0,
        2,
        3,
        0,
    ]  # where s fails p is not tried
    assert s(0.12).reason == p(0.12).reason == "2"
    assert (
        engines.solver_at_fixed_discretization(
            CELL, lights[0], (0.07, 0.23), tolerance=5e-4, engine="modal"
        )(0.12).reason
        == "1"
    )


def test_curves_of_one_task_are_those_of_tasks_of_their_own():
    """Both polarisations share modes and are told one after the other: as each by
    itself, since both need the same
    mesh here."""
    span, about = (0.1, 0.14), {"tolerance": 2e-2, "engine": "modal"}
    both = [Incidence(0.85, 0.2, "s"), Incidence(0.85, 0.2, "p")]
    joined = workers.run_task(workers.curves_task(CELL, both, span, **about))
    alone = [
        workers.run_task(workers.curves_task(CELL, [one], span, **about))
        for one in both
    ]
    assert joined["counts"] == [len(one["diameter_um"]) for one in alone]
    for made, one in zip(
        workers.solve_curves(joined, tolerance=2e-2), alone, strict=True
    ):
        (same,) = workers.solve_curves(one, tolerance=2e-2)
        assert (made.nodes.diameter_um == same.nodes.diameter_um).all()
        assert (
            np.abs(made.nodes.response - same.nodes.response).max() < 1e-9
        )  # products of other widths
        assert made.nodes.error == pytest.approx(same.nodes.error, rel=1e-5, abs=1e-9)
        assert made.nodes.reason == same.nodes.reason
    s, p = (
        made.nodes.response[0, 0]
        for made in workers.solve_curves(joined, tolerance=2e-2)
    )
    assert abs(s - p) > 0.01  # and not one of them twice


def test_bars_of_a_shared_mesh_are_no_less_than_those_of_the_mesh_that_a_thin_disc_has_by_itself():
    """Up to a disc of 0.8 pitches all diameters share the mesh of wide ones, whose
    factors are not those of discs of
    0.5: the larger estimate of both."""
    from metalens import modal

    cell, light, thin = (
        Cell(0.30, 0.5, Index(3.6)),
        Incidence(0.85),
        0.15,
    )  # of a pitch of 0.3
    rung = next(one for one in modal.RUNGS if one.name == "even")
    own, mesh = rung.choice(0.5), rung.choice(0.8)
    levels = engines._modal_levels(cell, light, 0.8 * cell.pitch_um, 1e-4)
    (at,) = [level for level in levels if level(thin).reason == "mesh even"]
    case = modal.case_of(cell, thin, light)
    made = modal.solve_on_mesh(case, mesh.plan, weak=rung.weak)
    ends = [one.factors.bound(made) for one in (own, mesh)]
    first = max(ends)
    assert at(thin).t_error == pytest.approx(
        first / (1 - first / 0.1), rel=1e-6
    )  # with the orders of a resonance
    assert ends[0] > 1.5 * ends[1]


def test_one_mesh_for_a_span_is_that_of_its_widest_pillar():
    """Wide discs ask for other meshes than slim ones: a slim one's answer then shows
    which its span has taken.
    """
    spans = (0.07, 0.23), (0.20, 0.23), (0.07, 0.10)
    own = [
        engines.solver_at_fixed_discretization(
            CELL, engines.Incidence(0.85), span, tolerance=1e-2, engine="modal"
        )(0.09)
        for span in spans
    ]
    assert (own[0].t, own[0].orders) == (own[1].t, own[1].orders)
    assert own[2].orders < own[0].orders
    assert abs(own[2].t - own[0].t) < own[0].t_error + own[2].t_error
