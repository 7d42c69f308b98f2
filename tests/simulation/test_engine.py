"""Who owns a simulated world: its engine, which lets it go with itself, never shares it, and says so when it is gone."""

from __future__ import annotations

import copy
import gc
import pickle

import cloudpickle
import numpy as np
import pytest

from marl_handover.envs import handover_aec
from marl_handover.errors import HandoverError
from marl_handover.simulation.engine import Engine, WorldClosed, WorldNotCopied, pybullet
from marl_handover.simulation.world import BulletCell


def connected(engine_client: int) -> bool:
    return bool(pybullet.isConnected(engine_client))


def test_a_world_that_nobody_holds_is_let_go(model, motion):
    cell = BulletCell(model, motion)
    client = cell.engine.client
    assert connected(client)
    del cell
    gc.collect()
    assert not connected(client)


def test_an_environment_that_nobody_holds_lets_its_world_go():
    env = handover_aec.env(backend="bullet")
    env.reset(seed=0)
    client = env.unwrapped.backend.cell.engine.client
    del env
    gc.collect()
    assert not connected(client)


COPIES = {"deepcopy": copy.deepcopy, "pickle": pickle.dumps, "cloudpickle": cloudpickle.dumps}


@pytest.mark.parametrize("copied", [copy.copy, *COPIES.values()], ids=["copy", *COPIES])
def test_a_world_is_not_copied(copied):
    engine = Engine()
    with pytest.raises(WorldNotCopied, match="cannot be copied or pickled; make another"):
        copied(engine)
    engine.close()


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_an_environment_with_a_world_is_not_copied(copied):
    env = handover_aec.env(backend="bullet")
    env.reset(seed=3)
    with pytest.raises(HandoverError, match="cannot be copied or pickled"):
        copied(env)
    env.close()


def test_a_closed_environment_says_so():
    env = handover_aec.env(backend="bullet")
    env.reset(seed=1)
    env.close()
    env.close()
    with pytest.raises(WorldClosed, match="was closed"):
        env.reset(seed=2)


def test_a_closed_world_does_not_act_in_the_one_that_got_its_number(model, motion):
    closed = BulletCell(model, motion)
    client = closed.engine.client
    closed.close()
    with BulletCell(model, motion) as other:
        assert other.engine.client == client, "else nothing is tested here"
        before = other.joints_rad()
        for act in (closed.joints_rad, closed.object_pose, closed.settle, lambda: closed.arms[0].place(np.ones(5), 0.0)):
            with pytest.raises(WorldClosed):
                act()
        np.testing.assert_array_equal(other.joints_rad(), before)
