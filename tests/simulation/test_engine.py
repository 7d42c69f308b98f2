"""Engines: each is found by its name, owns its world, lets it go with itself, never shares it, and says so when it is gone."""

from __future__ import annotations

import copy
import gc
import importlib.util
import os
import pickle
import subprocess
import sys
import weakref

import cloudpickle
import numpy as np
import pytest

from marl_handover.config import ENGINES
from marl_handover.envs import handover_aec
from marl_handover.errors import HandoverError, UnknownChoice, UrdfError
from marl_handover.simulation import engine as protocol
from marl_handover.simulation.engine import Engine, NoRenderer, WorldClosed, WorldNotCopied, default_engine
from marl_handover.simulation.world import SimulatedCell


def alive(world):
    """A function that says whether a world is still there, and does not hold it."""
    if type(world).__name__ != "BulletEngine":
        held = [weakref.ref(part) for part in world.world]
        return lambda: any(part() is not None for part in held)
    import pybullet

    client = world.client
    return lambda: bool(pybullet.isConnected(client))


def test_an_engine_has_all_that_the_protocol_says(engine):
    wanted = {name for name in vars(Engine) if not name.startswith("_")}
    made = ENGINES[engine]
    for name in wanted:
        assert getattr(made, name).__doc__, name


def test_a_world_that_nobody_holds_is_let_go(model, motion, engine):
    cell = SimulatedCell(model, motion, engine=engine)
    there = alive(cell.engine)
    assert there()
    del cell
    gc.collect()
    assert not there()


def test_an_environment_that_nobody_holds_lets_its_world_go(engine):
    env = handover_aec.env(backend=engine)
    env.reset(seed=0)
    there = alive(env.unwrapped.backend.cell.engine)
    del env
    gc.collect()
    assert not there()


@pytest.mark.slow
def test_fifty_environments_leave_no_memory_behind(engine):
    """In a process of its own: what other tests keep is not counted.

    What two of them add, one of which nobody closes: the median, as a drawing library takes 64 MiB at a time and gives it back late.
    """
    code = f"""
import gc, os
from marl_handover.cell import build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.envs import handover_aec
def used_mb():
    gc.collect()
    return int(open('/proc/self/statm').read().split()[1]) * os.sysconf('SC_PAGE_SIZE') / 1e6
seen = []
for number in range(50):
    env = handover_aec.env(backend={engine!r})
    env.reset(seed=number)
    env.unwrapped.backend.cell.camera_image(64, 36)
    if number % 2:
        env.close()
    del env
    seen.append(used_mb())
added = sorted(later - before for before, later in zip(seen[10:], seen[12:]))
print(20 * added[len(added) // 2])
"""
    if not os.path.exists("/proc/self/statm"):
        pytest.skip("memory is read from /proc")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout.split()[-1]) < 8


COPIES = {"deepcopy": copy.deepcopy, "pickle": pickle.dumps, "cloudpickle": cloudpickle.dumps}


@pytest.mark.parametrize("copied", [copy.copy, *COPIES.values()], ids=["copy", *COPIES])
def test_a_world_is_not_copied(copied, cell):
    with pytest.raises(WorldNotCopied, match="cannot be copied or pickled; make another"):
        copied(cell.engine)


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_an_environment_with_a_world_is_not_copied(copied, engine):
    env = handover_aec.env(backend=engine)
    env.reset(seed=3)
    with pytest.raises(HandoverError, match="cannot be copied or pickled"):
        copied(env)
    env.close()


def test_a_closed_environment_says_so(engine):
    env = handover_aec.env(backend=engine)
    env.reset(seed=1)
    env.close()
    env.close()
    with pytest.raises(WorldClosed, match="was closed"):
        env.reset(seed=2)


def test_a_closed_world_does_not_act_in_the_one_that_got_its_number(model, motion, engine):
    closed = SimulatedCell(model, motion, engine=engine)
    client = getattr(closed.engine, "client", None)
    closed.close()
    with SimulatedCell(model, motion, engine=engine) as other:
        assert getattr(other.engine, "client", None) == client, "else nothing is tested here"
        before = other.joints_rad()
        for act in (closed.joints_rad, closed.object_pose, closed.settle, lambda: closed.arms[0].place(np.ones(5), 0.0), closed.save):
            with pytest.raises(WorldClosed):
                act()
        np.testing.assert_array_equal(other.joints_rad(), before)


def test_engines_are_named(model, motion, monkeypatch):
    with pytest.raises(UnknownChoice, match="havok.*bullet, mujoco"):
        SimulatedCell(model, motion, engine="havok")
    there = {"pybullet": True, "mujoco": True}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if there[name] else None)
    assert default_engine() == "bullet"
    there["pybullet"] = False
    assert default_engine() == "mujoco"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "package", "other"), [("bullet", "pybullet", "mujoco"), ("mujoco", "mujoco", "pybullet")])
def test_an_engine_that_is_not_installed_is_named_with_the_line_that_installs_it(name, package, other):
    """And the other one is not needed to say so."""
    code = f"import sys; sys.modules.update({package}=None, {other}=None); from marl_handover.cli import main; sys.exit(main())"
    command = ["evaluate", "policy=exact", f"backend={name}", "episodes=1"]
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"physics engine {name} needs the package {package}; run: pip install" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "other"), [("bullet", "mujoco"), ("mujoco", "pybullet")])
def test_one_engine_does_without_the_other(engine, other):
    package = {"bullet": "pybullet"}.get(engine, engine)
    pytest.importorskip(package)
    code = f"""
import sys
sys.modules[{other!r}] = None
import marl_handover.simulation.film
from marl_handover.cell import build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.simulation.world import SimulatedCell
with SimulatedCell(build_cell(cell_config('paper')), MotionConfig(), engine={engine!r}) as cell:
    cell.settle()
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_opengl_pybullet_draws_what_mujoco_computes(model, motion, monkeypatch):
    mujoco = pytest.importorskip("marl_handover.simulation.mujoco")
    pytest.importorskip("pybullet")
    monkeypatch.setattr(mujoco, "gl_context", lambda: None)
    pictures = []
    for name in ("mujoco", "bullet"):
        with SimulatedCell(model, motion, engine=name) as cell:
            cell.reset((40.0, -30.0, 0.4))
            cell.show_goal((-60.0, 0.0, 1.0))
            pictures.append(cell.camera_image(320, 180).astype(int))
    assert (np.abs(pictures[0] - pictures[1]).max(-1) > 20).mean() < 0.002


def test_where_nothing_draws_one_line_says_what_would(model, motion, monkeypatch):
    mujoco = pytest.importorskip("marl_handover.simulation.mujoco")
    monkeypatch.setattr(mujoco, "gl_context", lambda: None)
    monkeypatch.setitem(ENGINES._entries, "bullet", lambda scene: (_ for _ in ()).throw(protocol.missing_engine("bullet", "pybullet")))
    with SimulatedCell(model, motion, engine="mujoco") as cell, pytest.raises(NoRenderer, match="run: apt-get install libegl1"):
        cell.camera_image(64, 36)


def test_an_arm_that_an_engine_cannot_take_is_named(model, motion, monkeypatch):
    mujoco = pytest.importorskip("marl_handover.simulation.mujoco")
    monkeypatch.setattr(mujoco, "mjcf", lambda scene, look: "<mujoco><worldbody><geom type='mesh' mesh='none'/></worldbody></mujoco>")
    with pytest.raises(UrdfError, match=r"al5a.*\.urdf: MuJoCo cannot take it: "):
        SimulatedCell(model, motion, engine="mujoco")


def test_a_state_is_gone_back_to(cell, engine, cycle):
    """In the middle of a cycle, with the block in the air, what follows is what followed before; Bullet forgets what presses."""
    cell.reset((30.0, -15.0, 0.0))
    phases = cycle(0, (30.0, -15.0), (-60.0, -5.0))
    cell.run(0, phases[:3])
    state, ends = cell.save(), []
    for again in (False, True):
        if again:
            cell.restore(state)
        cell.run(0, phases[3:])
        ends.append(np.concatenate([cell.object_pose(), cell.joints_rad().ravel()]))
    np.testing.assert_allclose(*ends, rtol=0, atol=0.0 if engine == "mujoco" else 0.3)
