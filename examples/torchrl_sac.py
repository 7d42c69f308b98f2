"""TorchRL's own SACLoss and replay buffer on SupervisorB: python examples/torchrl_sac.py [steps].

Everything is stock. Hindsight is one function: what a hand-over did is what the final transfer of the same arm would have done, had the
goal been there. Goals are turned a little, so that the policy also sees where success ends.
"""

from __future__ import annotations

import math
import sys

import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, NormalParamExtractor, TensorDictModule, set_interaction_type
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

import marl_handover as mh

EPSILON_DEG = 5.0
REWARD = {"success": 2.0, "step": -0.1, "failure": -3.0}  # the usual rewards over ten


def hindsight(env: mh.SupervisorEnv, steps: TensorDict) -> TensorDict:
    """The transitions that were carried out, each as the final transfer to about where it left the block."""
    rows = steps[steps["next", "feasible"][:, 0]].clone()
    goal = rows["next", "placed"].clone()
    goal[:, 2] += (2 * torch.rand(len(goal)) - 1) * 2 * math.radians(EPSILON_DEG) * (torch.rand(len(goal)) < 0.5)
    true = torch.ones(len(goal), dtype=torch.bool)
    rows["action"][:, 0] = 1.0
    rows["observation"] = env.observe(rows["achieved_goal"], goal, rows["previous_arm"][:, 0], rows["epsilon"][:, 0])
    rows["next", "reward"] = env.rules.judge(rows["next", "placed"], goal, true, true).reward[:, None].float()
    rows["next", "terminated"] = rows["next", "done"] = true[:, None]
    return rows


def train(steps: int = 150_000, cells: int = 64, hidden: int = 256, seed: int = 0, every: int = 10_000) -> list[tuple[int, float]]:
    """Train for ``steps`` transfers; (step, success rate) of 500 problems every so many."""
    torch.manual_seed(seed)
    settings = {"library": "torchrl", "epsilon_deg": EPSILON_DEG, "reward": REWARD, "seed": seed}
    env, judge = (mh.make("SupervisorB", num_envs=count, **settings) for count in (cells, 500))
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    net = nn.Sequential(MLP(size, 2 * actions, num_cells=[hidden] * 2, activation_class=nn.ReLU), NormalParamExtractor())
    module = TensorDictModule(net, ["observation"], ["loc", "scale"])
    actor = ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True, spec=env.action_spec)
    value = ValueOperator(MLP(size + actions, 1, num_cells=[hidden] * 2, activation_class=nn.ReLU), in_keys=["observation", "action"])
    loss = SACLoss(actor, value, target_entropy=-float(actions), alpha_init=0.1)
    loss.make_value_estimator(gamma=0.95)
    target, optimizer = SoftUpdate(loss, tau=0.005), torch.optim.Adam(loss.parameters(), lr=5e-4)
    memory = TensorDictReplayBuffer(storage=LazyTensorStorage(2 * steps), batch_size=256)
    state, curve = env.reset(), []
    for step in range(cells, steps + 1, cells):
        with torch.no_grad(), set_interaction_type(InteractionType.RANDOM):
            action = env.rand_action(state) if step < 2000 else actor(state)
            taken, state = env.step_and_maybe_reset(action)
        memory.extend(taken.select(*loss.in_keys, "achieved_goal"))
        memory.extend(hindsight(env, taken).select(*loss.in_keys, "achieved_goal"))
        for _ in range(cells // 4 if step >= 2000 else 0):
            losses = loss(memory.sample())
            sum(losses[name] for name in ("loss_actor", "loss_qvalue", "loss_alpha")).backward()
            optimizer.step()
            optimizer.zero_grad()
            target.step()
        if step // every > (step - cells) // every:
            with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
                ended = judge.rollout(20, actor, break_when_any_done=False)["next"]
            first = ended["done"][..., 0].int().argmax(1)
            won = ended["outcome"][torch.arange(500), first, 0] == 1
            curve.append((step, won.float().mean().item()))
            print(f"{step:7d} transfers: success {curve[-1][1]:.1%}", flush=True)
    return curve


if __name__ == "__main__":
    train(*(int(word) for word in sys.argv[1:2]))
