"""Training on the AEC environment: its rows are the batched path's, it repeats, goes on, and its workers do as they are told."""

from __future__ import annotations

import math
import multiprocessing
import os
import re
import shlex
import signal
import threading
import time
import warnings
from copy import deepcopy
from pathlib import Path

import pytest
import torch

from marl_handover.cluster import ClusterUnavailable
from marl_handover.commands import train
from marl_handover.compose import compose
from marl_handover.config import MotionConfig, NoiseConfig
from marl_handover.errors import HandoverError
from marl_handover.learning import aec_collector
from marl_handover.learning.aec_collector import AecCollector, WorkerLost, WorkerPolicy, make_env, message
from marl_handover.learning.collector import BatchedCollector
from marl_handover.learning.trainer import Trainer
from marl_handover.learning.variant import make_variant

HOWTO = Path(__file__).resolve().parents[2] / "docs" / "howto-aec.md"
architectures = pytest.mark.parametrize("architecture", ["A", "B"])


@pytest.fixture
def begin(small):
    """``begin("seed=1", ...)``: an experience, its environment's rules and a learner; closed in the end."""
    open_ones = []

    def make(*overrides):
        config = small("sac", "source=aec", *overrides)
        config.validate()
        variant = make_variant(config.variant)
        env = variant.env(config, torch.device("cpu"))
        experience = variant.collector(env, config)
        open_ones.append(experience)
        return experience, variant.algorithm(env.rules, config, torch.Generator().manual_seed(config.seed))

    yield make
    for experience in open_ones:
        experience.close()


def gather(experience, explore, calls):
    """Rows of some calls, transfers commanded, and what ended."""
    collected = [experience.collect(explore) for _ in range(calls)]
    rows = [one.rows for one in collected if one.rows is not None]
    return torch.cat(rows), sum(one.steps for one in collected), sum(one.ended for one in collected)


@architectures
def test_rows_are_the_rule_books(architecture, begin):
    """Every command of every whole episode, once and in order, with what it did; episodes as long as they are."""
    experience, learner = begin(f"task.architecture={architecture}", "task.max_steps=6", "num_envs=12", "task.epsilon_deg=20")
    rows, steps, ended = gather(experience, learner.random_action, 15)
    rules = experience.env.rules
    first, last = rows["elapsed"][:, 0] == 0, rows["remaining"][:, 0] == 0
    assert len(rows) <= steps <= len(rows) + 12 * 6
    assert int(first.sum()) == int(last.sum()) == int(ended[0]) > 20
    going = ~last[:-1]
    assert (rows["elapsed"][1:][going] == rows["elapsed"][:-1][going] + 1).all()
    for key in ("desired_goal", "epsilon"):
        assert (rows[key][1:][going] == rows[key][:-1][going]).all()
    assert (rows["achieved_goal"][1:][going] == rows["placed"][:-1][going]).all()
    assert (rows["previous_arm"][first] == -1).all()
    expected = rules.step(
        rows["achieved_goal"].double(),
        rows["desired_goal"].double(),
        rows["previous_arm"][:, 0],
        rows["action"].double(),
        transfers_left=rules.config.max_steps - rows["elapsed"][:, 0],
    )
    torch.testing.assert_close(rows["placed"].double(), expected.placed, atol=1e-3, rtol=0)
    assert (rows["feasible"][:, 0] == expected.feasible).all()
    assert (rows["terminated"][:, 0] == expected.terminated).all()
    made = expected.transfers[last] + rows["elapsed"][last, 0]
    assert (expected.terminated[last] | (made == rules.config.max_steps)).all()
    assert int(ended[2]) == int(made.sum())
    assert int(ended[1]) == int((expected.outcome[last] == 1).sum())


def test_rows_look_like_the_batched_environments(begin, small):
    """Same keys, types and shapes, so that a replay memory takes either."""
    experience, learner = begin()
    rows, _, _ = gather(experience, learner.random_action, 2)
    config = small("sac")
    config.validate()
    batched = make_variant(config.variant).collector(experience.env, config)
    assert isinstance(experience, AecCollector)
    assert isinstance(batched, BatchedCollector)
    other, _, _ = gather(batched, learner.random_action, 3)

    def looks(data):
        return {key: (value.dtype, value.shape[1:]) for key, value in data.items()}

    assert looks(rows) == looks(other)


def test_the_same_seed_brings_the_same_rows(begin):
    found = []
    for seed in (3, 3, 4):
        experience, learner = begin(f"seed={seed}")
        learner.generator.manual_seed(0)
        found.append(gather(experience, learner.random_action, 3)[0])
    assert (found[0] == found[1]).all()
    assert found[0].shape != found[2].shape or not (found[0]["achieved_goal"] == found[2]["achieved_goal"]).all()


def test_epsilons_follow_the_curriculum_and_are_seen(begin):
    """Drawn for each episode from the present range; the observation's last number tells it."""
    experience, learner = begin()
    seen = []

    def explore(observation):
        seen.append(observation)
        return learner.random_action(observation)

    experience.env.set_epsilon_range(2.0, 2.0)
    first, _, _ = gather(experience, explore, 2)
    torch.testing.assert_close(first["epsilon"], torch.full_like(first["epsilon"], math.radians(2.0)))
    torch.testing.assert_close(seen[-1][:, -1], torch.full((16,), math.log(math.radians(2.0)) / 4))
    experience.env.set_epsilon_range(1.0, 10.0)
    rows, _, _ = gather(experience, explore, 6)
    drawn = rows["epsilon"][rows["elapsed"] == 0][5:].rad2deg()
    assert 1.0 <= drawn.min() < 2.0 < 5.0 < drawn.max() <= 10.0


def test_a_run_that_goes_on_begins_other_problems(begin):
    experience, learner = begin()
    rows, steps, _ = gather(experience, learner.random_action, 2)
    state = experience.state_dict()
    assert state["decisions"] == steps
    other, learner = begin()
    other.load_state_dict(state)
    later, more, _ = gather(other, learner.random_action, 2)
    assert other.state_dict()["decisions"] == steps + more
    assert not set(map(tuple, rows["desired_goal"].tolist())) & set(map(tuple, later["desired_goal"].tolist()))


def test_a_run_that_goes_on_draws_the_memorys_next_epsilons(begin):
    experience, _ = begin()
    experience.env.set_epsilon_range(1.0, 10.0)
    experience.env.draw_epsilon(5)
    state = experience.state_dict()
    expected = experience.env.draw_epsilon(5)
    other, _ = begin()
    other.env.set_epsilon_range(1.0, 10.0)
    other.load_state_dict({"decisions": 0})  # as older versions wrote it
    other.load_state_dict(state)
    assert torch.equal(other.env.draw_epsilon(5), expected)


def test_a_command_that_was_ignored_is_told_from_one_that_an_arm_refused(begin):
    experience, learner = begin("task.architecture=A", "num_envs=12", "task.epsilon_deg=60", "task.max_steps=6")
    rows, _, _ = gather(experience, learner.random_action, 12)
    rules = experience.env.rules
    problem = rows["achieved_goal"].double(), rows["desired_goal"].double()
    solved = rules.can_finish(*problem).any(-1)
    assert torch.equal(rows["ignored"][:, 0], solved)
    refused = ~rows["feasible"][:, 0] & ~solved
    assert min(int(solved.sum()), int(refused.sum())) > 3
    assert not rules.transfer(*problem, rules.decode(rows["action"].double()))[1][refused].any()


def test_workers_explore_as_far_as_training_is(small):
    """DQN's share of random choices falls in the workers as it does here."""
    config = small("dqn", "source=aec", "algorithm.random_end=0.1", "algorithm.random_until=0.5")
    config.validate()
    variant = make_variant(config.variant)
    rules = variant.env(config, torch.device("cpu")).rules
    learner = variant.algorithm(rules, config, torch.Generator().manual_seed(0))
    worker = WorkerPolicy(deepcopy(config), 1, 5)
    seen = make_env(config, [3]).reset()
    for fraction in (0.0, 0.25, 0.5, 1.0):
        learner.schedule(fraction)
        told = message(learner.explore, (0.1, 0.1))
        worker.weights.data, worker.orders.data = told["weights"], told["orders"]
        worker(seen)
        assert worker._learner.random_share == pytest.approx(learner.random_share)
    assert worker._learner.random_share == pytest.approx(0.1)


@pytest.mark.slow
def test_a_run_learns_from_it_stops_and_goes_on(small, tmp_path, table):
    config = small(
        "sac", "source=aec", "steps=320", "evaluation_interval=160", "checkpoint_interval=160", "algorithm.env_steps_per_gradient_step=32"
    )

    def stop(row):
        if row["step"] < 200:
            raise KeyboardInterrupt

    trainer = Trainer(config, tmp_path, on_evaluation=stop)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    trainer.save()
    again = Trainer(config, tmp_path)
    again.restore()
    assert (again.counters.step, len(again.replay)) == (trainer.counters.step, len(trainer.replay))
    summary = again.run()
    assert summary["step"] == 320
    assert summary["gradient_step"] == (320 - config.algorithm.learning_starts) // 32
    assert [row["step"] for row in table(tmp_path)] == ["160", "320"]


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        (["source=aec", "algorithm=ppo"], "source"),
        (["source=aec", "variant=decentralised"], "source"),
        (["source=aec", "backend=bullet"], "executor"),
        (["source=aec", "backend=mujoco"], "executor"),
        (["source=aec", "backend=robot"], "backend"),
        (["source=aec", "executor=magic"], "executor"),
        (["source=aec", "collector=threads"], "collector"),
        (["source=aec", "task.noise.position_mm=1"], "task.noise"),
        (["source=aec", "backend=noisy", "task.noise.observed_mm=1"], "task.noise"),
        (["collector=ray"], "collector"),
        (["backend=noisy"], "backend"),
    ],
)
def test_what_cannot_be_is_refused_by_name(settings, name):
    with pytest.raises(HandoverError, match=f"^{name} = "):
        compose(train.SCHEMA, settings, groups=train.GROUPS, aliases=train.ALIASES).validate()


def test_noisy_arms_are_judged_by_what_is_measured(begin):
    """A hand-over lands beside its place; a final one is good within the tolerance, and so is hindsight's, whose goal is where it aimed."""
    experience, learner = begin("backend=noisy", "task.noise.position_mm=2", "task.noise.yaw_deg=1", "num_envs=40")
    rows, _, _ = gather(experience, learner.random_action, 3)
    rules = experience.env.rules
    assert rules.tolerance_mm == 5.0
    assert rules.cell.config.chart_inset == 0.99
    planned, feasible = rules.transfer(rows["achieved_goal"], rows["desired_goal"], rules.decode(rows["action"]))
    moved = rows["feasible"][:, 0] & (rows["placed"] != rows["achieved_goal"]).any(-1)
    assert (feasible | ~rows["feasible"][:, 0]).all()
    off = (rows["placed"] - planned)[moved][:, :2]
    assert 1.0 < float(off.std()) < 3.0
    replay = make_variant(experience.config.variant).replay(experience.env, experience.config, torch.Generator().manual_seed(0))
    replay.extend(rows)
    batch = replay.sample(3000)
    missed = (batch["next", "achieved_goal"] - batch["desired_goal"])[:, :2].norm(dim=-1)
    turned = rules.orientation_error(batch["next", "achieved_goal"][:, 2], batch["desired_goal"][:, 2]).abs()
    carried = (batch["next", "achieved_goal"] != batch["achieved_goal"]).any(-1)
    for finals in (batch["final"] & batch["hindsight"], batch["final"] & ~batch["hindsight"]):
        rows_of = finals[:, 0] & carried
        good = (missed <= 5.0) & (turned <= batch["epsilon"][:, 0])
        assert torch.equal(batch["next", "reward"][rows_of, 0], torch.where(good, 20.0, -30.0)[rows_of])
        assert 1.0 < float(missed[rows_of].mean()) < 4.0


def test_noisy_arms_are_watched_with_their_noise(begin, engine):
    """The backend's own if the task has none; physics has none that is known."""
    experience, _ = begin("backend=noisy")
    assert experience.env.rules.config.noise == NoiseConfig(position_mm=1.0, yaw_deg=0.5)
    assert not begin(f"backend={engine}", "executor=optimised")[0].env.rules.noisy


def only_finishing(learner):
    """Change the learner's actor, its average too, so that it always says "final"."""
    with torch.no_grad():
        for actor in (learner.actor(), learner.trained()):
            actor.net[-1].bias[0] += 1000.0


def check_workers(experience, learner):
    """First uniform actions, then the new weights' own, of every worker."""
    rows, steps, _ = gather(experience, learner.random_action, 2)
    assert steps == 32
    assert 0.2 < float((rows["action"][:, 0] > 0).float().mean()) < 0.8
    only_finishing(learner)
    experience.env.set_epsilon_range(3.0, 3.0)
    gather(experience, learner.explore, 1)  # may end episodes that began before
    rows, _, _ = gather(experience, learner.explore, 2)
    assert (rows["action"][:, 0] > 0).all()
    fresh = rows[rows["elapsed"][:, 0] == 0]
    torch.testing.assert_close(fresh["epsilon"], torch.full_like(fresh["epsilon"], math.radians(3.0)))
    goals = fresh["desired_goal"]
    assert len(goals.unique(dim=0)) == len(goals), "workers have problems of their own"
    with pytest.raises(TypeError, match="not by"):
        experience.collect(lambda observation: observation)


@pytest.fixture
def worker(monkeypatch):
    """A process that lives until it is killed."""
    monkeypatch.setattr(aec_collector, "LOOK_S", 0.05)
    monkeypatch.setattr(aec_collector, "GRACE_S", 0.2)
    process = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,), daemon=True)
    process.start()
    yield process
    process.kill()
    process.join()


def test_what_never_comes_from_a_killed_worker_is_not_waited_for(worker):
    threading.Timer(0.3, lambda: os.kill(worker.pid, signal.SIGKILL)).start()
    with pytest.raises(ChildProcessError, match=f"process {worker.pid} ended with -9"):
        aec_collector.watched(threading.Event().wait, lambda: [worker])


def test_what_living_workers_bring_is_waited_for_and_their_errors_are_passed_on(worker):
    brought = threading.Event()
    threading.Timer(0.4, brought.set).start()
    assert aec_collector.watched(brought.wait, lambda: [worker]) is True
    with pytest.raises(ZeroDivisionError):
        aec_collector.watched(lambda: 1 / 0, lambda: [worker])
    worker.kill()
    worker.join()
    assert aec_collector.watched(lambda: "was under way", lambda: [worker]) == "was under way"


def test_a_dead_ray_address_is_told_at_once_and_is_no_lost_worker(begin, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    experience, learner = begin("collector=ray")
    with pytest.raises(ClusterUnavailable, match="RAY_ADDRESS=127.0.0.1:1: Connection refused"):
        experience.collect(learner.explore)


@pytest.mark.slow
@pytest.mark.parametrize("moment_s", [0.0, 0.02, 0.05, 0.1, 0.3])
def test_a_worker_killed_at_any_moment_ends_the_run(begin, moment_s):
    experience, learner = begin("collector=multiprocess")
    gather(experience, learner.random_action, 1)
    workers = experience._collector.procs
    threading.Timer(moment_s, lambda: os.kill(workers[1].pid, signal.SIGKILL)).start()
    with pytest.raises(WorkerLost, match="resume=RUN"):
        gather(experience, learner.explore, 300)
    experience.close()
    assert not any(not worker._closed and worker.is_alive() for worker in workers)


@pytest.mark.slow
def test_processes_do_as_they_are_told_and_their_loss_is_named(begin):
    experience, learner = begin("collector=multiprocess")
    check_workers(experience, learner)
    workers = experience._collector.procs
    os.kill(workers[0].pid, signal.SIGKILL)
    workers[0].join()
    with pytest.raises(WorkerLost, match="ended with -9.*resume=RUN"):
        gather(experience, learner.explore, 3)
    experience.close()
    assert not any(not worker._closed and worker.is_alive() for worker in workers)


@pytest.mark.slow
def test_ray_actors_do_as_they_are_told_and_their_loss_is_named(begin):
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        experience, learner = begin("collector=ray")
        check_workers(experience, learner)
        ray.kill(experience._collector.remote_collectors[0])
        with pytest.raises(WorkerLost, match="resume=RUN"):
            gather(experience, learner.explore, 3)
        experience.close()
        assert ray.is_initialized(), "the cluster is not the run's"
    finally:
        ray.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("collector", ["local", "multiprocess"])
def test_physics_brings_rows(collector, begin, engine):
    """Planned paths of arms with a friction grasp; most transfers within reach come out within millimetres."""
    experience, learner = begin(f"backend={engine}", "executor=optimised", f"collector={collector}", "num_envs=6")

    def explore(observation):
        return learner.random_action(observation)

    rows, steps, _ = gather(experience, explore if collector == "local" else learner.random_action, 3)
    rules = experience.env.rules
    planned, _ = rules.transfer(rows["achieved_goal"], rows["desired_goal"], rules.decode(rows["action"]))
    done = rows["feasible"][:, 0]
    assert steps == 18
    assert int(done.sum()) >= 3
    off = (rows["placed"] - planned)[done][:, :2].norm(dim=-1)
    assert float(off.median()) < 3.0


@pytest.mark.parametrize("method", ["direct", "optimised"])
def test_executors_take_the_motion_defaults(method, begin):
    """Either kind carries out what is feasible; the planner declines what it finds no path for."""
    experience, learner = begin(f"executor={method}", "num_envs=10")
    rows, _, _ = gather(experience, learner.random_action, 2)
    rules = experience.env.rules
    _, feasible = rules.transfer(rows["achieved_goal"], rows["desired_goal"], rules.decode(rows["action"]))
    assert (feasible | ~rows["feasible"][:, 0]).all()
    assert int(rows["feasible"].sum()) >= 0.9 * int(feasible.sum())
    assert experience._policy._arms["arm_left"].motion == MotionConfig()


TEXT = HOWTO.read_text(encoding="utf-8")


def test_the_howtos_code_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(compile(code, str(HOWTO), "exec"), {"__name__": "howto"})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert [sum(int(line.split()[index]) for line in lines) for index in (0, 2)] == [100, 50]


@pytest.mark.parametrize("line", re.findall(r"^ *marl-handover train (.*)", TEXT, re.MULTILINE))
def test_the_howtos_commands_are_ones(line):
    compose(train.SCHEMA, shlex.split(line), groups=train.GROUPS, aliases=train.ALIASES).validate()
