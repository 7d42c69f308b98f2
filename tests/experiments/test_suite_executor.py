"""Fanning out over processes that may fail, die or be told to stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest

from marl_handover.errors import InvalidSetting, MissingExtra, UnknownChoice
from marl_handover.experiments.executor import LAUNCHERS, Failure, fan_out

WAIT_S = 20


def noted(job):
    """Leave a file that tells item and process; then do what the item asks for."""
    folder, item, wish = job
    first = not list(folder.glob(f"{item}.*"))
    (folder / f"{item}.{os.getpid()}.{time.monotonic_ns()}").touch()
    if wish == "slow":
        time.sleep(0.4)
    if wish == "die" or (wish == "die once" and first):
        os.kill(os.getpid(), signal.SIGKILL)
    if wish == "raise":
        raise ValueError(f"item {item}\nis not welcome")
    if wish == "leave":
        sys.exit(3)
    return (item, item**2) if wish != "unpicklable" else (item, threading.Lock())


def play(folder, wishes, **options):
    jobs = [(folder, item, wish) for item, wish in enumerate(wishes)]
    pairs = list(fan_out(noted, jobs, progress=False, **options))
    assert sorted(item for (_, item, _), _ in pairs) == list(range(len(wishes)))
    return {item: result for (_, item, _), result in pairs}


def starts(folder):
    return Counter(int(path.name.split(".")[0]) for path in folder.iterdir())


def pids(folder):
    return {int(path.name.split(".")[1]) for path in folder.iterdir()}


def assert_gone(processes):
    """Every process has ended, or does before long."""
    deadline = time.monotonic() + WAIT_S
    while left := [pid for pid in processes if _alive(pid)]:
        assert time.monotonic() < deadline, left
        time.sleep(0.05)


def _alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_item_has_the_result_of_its_function(tmp_path, jobs):
    assert play(tmp_path, [""] * 7, jobs=jobs) == {item: (item, item**2) for item in range(7)}
    assert starts(tmp_path) == dict.fromkeys(range(7), 1)
    assert (pids(tmp_path) == {os.getpid()}) == (jobs == 1)
    assert_gone(pids(tmp_path) - {os.getpid()})


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_no_items_no_results_and_no_cluster(launcher):
    assert list(fan_out(noted, [], launcher=launcher, progress=False)) == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_exception_fails_its_item_only(tmp_path, jobs):
    results = play(tmp_path, ["", "raise", "leave", "unpicklable", ""], jobs=jobs)
    assert {item for item, result in results.items() if isinstance(result, Failure)} == {1, 2, 3}
    failure = results[1]
    assert failure.error.startswith("ValueError: item 1 is not welcome (test_suite_executor.py, line ")
    assert failure.error.endswith(", in noted)")
    assert "Traceback" in failure.traceback
    assert failure.item == (tmp_path, 1, "raise")
    assert not any(results[item].worker_died for item in (1, 2, 3))
    assert results[2].error.startswith("SystemExit: 3")
    assert starts(tmp_path) == dict.fromkeys(range(5), 1)


def test_a_dead_worker_costs_nothing_that_was_finished(tmp_path, caplog):
    results = play(tmp_path, ["", "", "", "slow", "die once", "slow", "", ""], jobs=2, label=lambda job: f"item {job[1]}")
    assert results == {item: (item, item**2) for item in range(8)}
    assert "item 4: a worker died; starting it again (2 of 3)" in caplog.text
    again = {item for item, count in starts(tmp_path).items() if count > 1}
    assert {4} <= again <= {3, 4, 5}
    assert len(again) <= 2, "besides the item of the dead worker, the one that ran beside it"


@pytest.mark.parametrize("attempts", [1, 3])
def test_an_item_that_no_worker_survives_is_given_up(tmp_path, attempts):
    results = play(tmp_path, ["", "die", "", ""], jobs=2, attempts=attempts)
    assert starts(tmp_path)[1] == attempts
    assert results[1].worker_died
    assert "Traceback" not in results[1].traceback
    if attempts > 1:
        assert {item: results[item] for item in (0, 2, 3)} == {item: (item, item**2) for item in (0, 2, 3)}


def test_a_neighbour_of_one_that_always_dies_is_not_given_up(tmp_path):
    results = play(tmp_path, ["slow", "die"], jobs=2, attempts=3)
    assert results[0] == (0, 0)
    assert results[1].worker_died
    assert starts(tmp_path)[1] == 3


def test_workers_keep_to_one_numerical_thread():
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    ((_, values),) = fan_out(lambda wanted: [os.environ.get(name) for name in wanted], [names], jobs=2, progress=False)
    assert values == ["1"] * len(names)


def test_leaving_early_ends_the_workers(tmp_path):
    jobs = [(tmp_path, item, "slow") for item in range(50)]
    with closing(fan_out(noted, jobs, jobs=2, progress=False)) as pairs:
        next(pairs)
    assert_gone(pids(tmp_path))
    assert len(starts(tmp_path)) < 10


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_the_process_that_started_it(tmp_path, how):
    script = f"""
    import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
    from pathlib import Path
    from marl_handover.experiments.executor import fan_out
    from test_suite_executor import noted
    for _ in fan_out(noted, [(Path({str(tmp_path)!r}), item, "slow") for item in range(200)], jobs=2, progress=False):
        pass
    """
    driver = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + WAIT_S
    while len(starts(tmp_path)) < 3:
        assert time.monotonic() < deadline
        assert driver.poll() is None, driver.stderr.read()
        time.sleep(0.05)
    driver.send_signal(how)
    _, err = driver.communicate(timeout=WAIT_S)
    assert driver.returncode != 0
    assert_gone(pids(tmp_path))
    if how == signal.SIGINT:
        assert err.rstrip().endswith("KeyboardInterrupt"), err


def test_the_bar_counts_items(capsys, tmp_path):
    list(fan_out(noted, [(tmp_path, item, "") for item in range(3)], jobs=1, label=lambda job: f"number {job[1]}"))
    assert "3/3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "error"), [({"launcher": "slurm"}, UnknownChoice), ({"jobs": -1}, InvalidSetting), ({"attempts": 0}, InvalidSetting)]
)
def test_bad_arguments_are_refused_before_anything_starts(options, error):
    with pytest.raises(error):
        fan_out(noted, [], **options)


def test_ray_that_is_not_installed_names_the_line_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"pip install 'ray>="):
        list(fan_out(noted, [1], launcher="ray", progress=False))
