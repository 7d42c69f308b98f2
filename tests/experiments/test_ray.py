"""A real Ray cluster on this machine loses a worker in mid-run, and nothing else."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import cloudpickle
import pytest

from marl_handover.cli import main
from marl_handover.cluster import WORKER_NICENESS, ClusterUnavailable, _root_cause, connected
from marl_handover.experiments.executor import Failure, fan_out

cluster_utils = pytest.importorskip("ray.cluster_utils", reason="ray is not installed (pip install 'marl_handover[ray]')")

ITEM_S = 0.7
cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the nodes cannot import a test module


class Started(NamedTuple):
    """One execution of an item."""

    item: int
    node: str
    pid: int


@pytest.fixture(scope="module")
def cluster():
    """A head without cores that soon notices when a node is gone."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    quick = {"health_check_period_ms": 500, "health_check_timeout_ms": 2000, "health_check_failure_threshold": 3}
    head = {"num_cpus": 0, "include_dashboard": False, "_system_config": quick}
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
    yield cluster
    cluster.shutdown()


@pytest.fixture
def two_nodes(cluster):
    """The nodes that work, one core each; what a test before has killed is replaced."""
    while len(cluster.worker_nodes) < 2:
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    return sorted(cluster.worker_nodes, key=lambda node: node.node_id)


def recorded(job):
    """Leave a file when an item starts and another when it is done."""
    import ray

    folder, item = job
    name = f"{item}.{ray.get_runtime_context().get_node_id()}.{os.getpid()}"
    (folder / f"{name}.started").touch()
    time.sleep(ITEM_S)
    (folder / f"{name}.done").touch()
    return 10 * item


def executions(folder, what):
    return {Started(int(item), node, int(pid)) for item, node, pid, _ in (path.name.split(".") for path in folder.glob(f"*.{what}"))}


def run_and_kill(cluster, folder, kill):
    """Items and results of eight items; ``kill`` is given one execution that is under way after two of them are done."""
    jobs = [(folder, item) for item in range(8)]
    results, victim = [], None
    with closing(
        fan_out(recorded, jobs, launcher="ray", address=cluster.address, label=lambda job: f"item {job[1]}", progress=False)
    ) as pairs:
        for (_, item), result in pairs:
            assert not isinstance(result, Failure), result.traceback
            results.append((item, result))
            if len(results) == 2:
                victim = under_way(folder)
                kill(victim)
    return results, victim


def under_way(folder):
    """An execution that has just begun."""
    known = executions(folder, "started")
    for _ in range(200):
        fresh = executions(folder, "started") - known - executions(folder, "done")
        if fresh:
            return fresh.pop()
        time.sleep(0.05)
    raise AssertionError("nothing was started for ten seconds")


def assert_nothing_is_lost(folder, results, victim):
    assert sorted(results) == [(item, 10 * item) for item in range(8)]
    assert Counter(execution.item for execution in executions(folder, "done")) == dict.fromkeys(range(8), 1)
    again = Counter(execution.item for execution in executions(folder, "started")) - Counter(range(8))
    assert again == {victim.item: 1}


@pytest.mark.slow
def test_a_worker_process_dies_in_mid_run(cluster, two_nodes, tmp_path):
    results, victim = run_and_kill(cluster, tmp_path, lambda victim: os.kill(victim.pid, signal.SIGKILL))
    assert_nothing_is_lost(tmp_path, results, victim)


def fails(item):
    if item == 1:
        raise ValueError("one is not welcome")
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_a_failing_item_is_reported_and_the_others_go_on(cluster, two_nodes):
    results = dict(fan_out(fails, range(4), launcher="ray", address=cluster.address, attempts=2, progress=False))
    assert (results[0], results[3]) == (0, 3)
    assert isinstance(results[1], Failure)
    assert "ValueError: one is not welcome" in results[1].error
    assert results[2].worker_died
    assert "2 times" in results[2].error


@pytest.mark.slow
def test_a_node_dies_in_mid_run(cluster, two_nodes, tmp_path, caplog):
    def kill(victim):
        (node,) = [node for node in two_nodes if node.node_id == victim.node]
        os.kill(victim.pid, signal.SIGSTOP)  # a worker outlives its node by a moment, in which it could finish
        cluster.remove_node(node, allow_graceful=False)
        with contextlib.suppress(ProcessLookupError):
            os.kill(victim.pid, signal.SIGKILL)

    results, victim = run_and_kill(cluster, tmp_path, kill)
    assert_nothing_is_lost(tmp_path, results, victim)
    assert f"item {victim.item}: a worker died" in caplog.text
    assert {execution.node for execution in executions(tmp_path, "started")} == {node.node_id for node in two_nodes}


def test_a_cluster_that_is_not_there_is_one_line():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    for where in (address, f"ray://{address}"):
        with pytest.raises(ClusterUnavailable, match="ray start --head") as error:
            list(fan_out(fails, [0], launcher="ray", address=where, progress=False))
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("own", [None, "7"])
def test_workers_of_a_cluster_that_is_started_here_are_not_behind_all_others(monkeypatch, own):
    monkeypatch.setenv(WORKER_NICENESS, own or "")
    if own is None:
        monkeypatch.delenv(WORKER_NICENESS)
    seen = []

    def init(**options):
        seen.append(os.environ[WORKER_NICENESS])

    with connected(SimpleNamespace(is_initialized=lambda: False, init=init, shutdown=lambda: None), "local", 1):
        assert seen == [own or "0"]


@pytest.mark.slow
def test_a_worker_of_a_cluster_that_is_started_here_runs_as_this_process_does():
    import ray

    with connected(ray, "local", 1):
        assert ray.get(ray.remote(lambda: os.nice(0)).remote()) == os.nice(0)


def test_what_ray_wraps_in_advice_is_told_by_its_cause():
    def connect():
        try:
            raise RuntimeError("Version mismatch: the cluster was started with Ray: 2.9\n  This process: Ray: 2.60")
        except RuntimeError as error:
            raise ConnectionError("ray client connection failed. Start Ray with: ray start --head") from error

    with pytest.raises(ConnectionError) as caught:
        connect()
    assert _root_cause(caught.value) == "RuntimeError: Version mismatch: the cluster was started with Ray: 2.9"
    assert "ray start" not in str(ClusterUnavailable("auto", _root_cause(caught.value), absent=False))


SUITE = """
title: Small
seeds: 4
train: [compile=off, steps=512, num_envs=16, evaluation_interval=256, evaluation_episodes=30, checkpoint_interval=256,
        algorithm.learning_starts=200, algorithm.batch_size=16]
rows:
  - {name: b, train: []}
evaluations:
  - {name: kinematic, arguments: [episodes=40]}
"""


def holder(folder):
    """The process that has the lock of a task's folder, or None."""
    inode = folder.with_name(f"{folder.name}.lock").stat().st_ino
    held = (line.split() for line in Path("/proc/locks").read_text().splitlines() if "FLOCK" in line and "->" not in line)
    return next((int(fields[4]) for fields in held if int(fields[5].split(":")[2]) == inode), None)


def parent(pid):
    """The process that started another."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest.mark.slow
def test_a_suite_survives_the_death_of_a_node(cluster, two_nodes, tmp_path, caplog):
    (tmp_path / "small.yaml").write_text(SUITE)
    out = tmp_path / "out"
    early = {}

    def kill():
        worker = None
        while not (early and worker):
            early.update({path: path.stat().st_mtime_ns for path in out.glob("b/seed*/*.json") if (path.parent / "done.json").exists()})
            worker = next(
                filter(None, (holder(run.parent) for run in out.glob("b/seed*/run") if not (run.parent / "done.json").exists())), None
            )
            time.sleep(0.02)
        os.kill(worker, signal.SIGSTOP)  # a worker outlives its node by a moment, in which it could finish
        (node,) = [node for node in two_nodes if node.all_processes["raylet"][0].process.pid == parent(worker)]
        cluster.remove_node(node, allow_graceful=False)
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    arguments = [f"suite={tmp_path / 'small.yaml'}", f"out={out}", "launcher=ray", f"address={cluster.address}", "progress=false"]
    assert main(["compare", *arguments]) == 0
    killer.join()
    assert "a worker died" in caplog.text
    assert all((out / f"b/seed{seed}/done.json").exists() for seed in range(4))
    assert early
    assert {path: path.stat().st_mtime_ns for path in early} == early, "what was finished was not run again"
    assert json.loads((out / "results.json").read_text())["missing"] == []
