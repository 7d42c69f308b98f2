"""Trained actors, evaluated in numpy: a supervisor's, one over a grid of places, and arms that take turns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import select
from marl_handover.baselines.dqn_grid import goal_reach, grid_actions, seen_by_finishers
from marl_handover.cell import NO_ARM
from marl_handover.policies.files import Layers, network_layers
from marl_handover.policies.policy import Floats, SupervisorPolicy
from marl_handover.task.observations import ARM_FIELDS, ODD_FIELDS, observe
from marl_handover.task.rules import Rules


class NetworkPolicy(SupervisorPolicy):
    """A trained actor, evaluated in numpy.

    Args:
        rules: the rule book to act under.
        name: what it was loaded as.
        arrays: weights, from a policy file.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name)
        self.about |= about
        self.variant = about["variant"]
        self.layers = network_layers(arrays, about)
        self.hybrid = about["kind"] == "hybrid"
        self.odd = np.array([-1.0 if field in ODD_FIELDS else 1.0 for field in ARM_FIELDS], np.float32)
        self.place_sign = np.array(rules.cell.views, np.float32)
        self.sines = [ARM_FIELDS.index(field) for field in ("sin_hand_over", "sin_finish_error")]
        self.angles = [ARM_FIELDS.index(field) for field in ("cos_finish_error", "cos_hand_over")]

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The likeliest branch and its mean place."""
        observation = self._observation(pose, goal, previous_arm)
        if not self.hybrid:
            return np.tanh(self._forward(observation)[..., :4])
        logits, place = self._branches(observation)
        return self._action(logits.argmax(-1), place)

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All branches, the likeliest first, where it has branches."""
        if not self.hybrid:
            return super().alternatives(action, pose, goal, previous_arm)
        logits, place = self._branches(self._observation(pose, goal, previous_arm))
        order = np.argsort(-logits, -1, kind="stable")
        return np.stack([self._action(order[..., rank], place) for rank in range(order.shape[-1])], -2)

    def _observation(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> NDArray[np.float32]:
        if not self.about["task"].get("previous_arm", True):  # files of older versions do not say
            previous_arm = 0 * previous_arm - 1
        return observe(self.rules, self.about["layout"], pose, goal, previous_arm).astype(np.float32)

    def _forward(self, x: NDArray[np.float32], layers: Layers | None = None) -> NDArray[np.float32]:
        layers = layers or self.layers
        for weight, bias in layers[:-1]:
            x = np.maximum(x @ weight + bias, 0)
        weight, bias = layers[-1]
        return x @ weight + bias

    def _branches(self, observation: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Of the choices (arm, final or component): logits (..., arms * (1 + components)), and places (..., arms * components, 2)."""
        components = self.about["modes"]
        blocks = observation.reshape(*observation.shape[:-1], -1, len(ARM_FIELDS))
        sign = self._sign(blocks)
        turned = np.where(sign[..., None] < 0, blocks * self.odd, blocks)
        out = self._forward(self._harmonics(turned))
        logits = out[..., : 1 + components]
        if self.rules.external_finish:
            logits[..., 0] = -math.inf
        mean = np.tanh(out[..., 1 + components : 1 + 3 * components]).reshape(*out.shape[:-1], components, 2)
        signs = np.stack(np.broadcast_arrays(sign * self.place_sign[:, 0], self.place_sign[:, 1]), -1)
        place = mean * signs[..., None, :]
        return logits.reshape(*logits.shape[:-2], -1), place.reshape(*place.shape[:-3], -1, 2)

    def _action(self, branch: NDArray[np.int64], place: NDArray[np.float32]) -> Floats:
        """Actions (..., 4) of branches (...)."""
        components = self.about["modes"]
        arm, choice = np.divmod(branch, 1 + components)
        index = arm * components + np.maximum(choice - 1, 0)
        where = np.take_along_axis(place, np.asarray(index)[..., None, None], -2)[..., 0, :]
        return np.stack([np.where(choice == 0, 1.0, -1.0), 2.0 * arm - 1.0, where[..., 0], where[..., 1]], -1)

    def _sign(self, blocks: NDArray[np.float32]) -> NDArray[np.float32]:
        if not self.about["canonical"]:
            return np.ones_like(blocks[..., 0])
        hand_over, finish = (blocks[..., index] for index in self.sines)
        return np.where(np.where(hand_over == 0, finish, hand_over) < 0, np.float32(-1), np.float32(1))

    def _harmonics(self, blocks: NDArray[np.float32]) -> NDArray[np.float32]:
        parts = [blocks]
        for index in self.angles:
            cosine, sine = blocks[..., index], blocks[..., index + 1]
            for _ in range(self.about["harmonics"]):
                cosine, sine = cosine * cosine - sine * sine, 2 * sine * cosine
                parts.append(np.stack([cosine, sine], -1))
        return np.concatenate(parts, -1)


class DiscretePolicy(NetworkPolicy):
    """The choice with the highest value; architecture A has a network for each finishing arm, B one for hand-overs and one for finishing.

    Args:
        rules: the rule book to act under. Places keep their position on the table, also in another chart.
        name: what it was loaded as.
        arrays: weights, from a policy file.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name, arrays, about)
        self.networks = [network_layers(arrays, about, number) for number in range(about["networks"])]
        self.points_mm = np.array(about["points_mm"])

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The best choice."""
        return self._actions()[self.values(pose, goal, previous_arm).argmax(-1)]

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All choices, the best first."""
        return self._actions()[np.argsort(-self.values(pose, goal, previous_arm), -1, kind="stable")]

    def values(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> NDArray[np.float32]:
        """Values (..., choices)."""
        observation = self._observation(pose, goal, previous_arm)
        if not self.rules.external_finish:
            return np.concatenate([self._forward(observation, layers) for layers in self.networks], -1)
        layout = self.about["layout"]
        seen = seen_by_finishers(self.rules, layout, observation)
        value = np.stack([self._forward(seen[..., arm, :], layers) for arm, layers in enumerate(self.networks)], -1)
        return np.where(goal_reach(self.rules, layout, observation)[..., None, :], value, -math.inf).max(-1)

    def _actions(self) -> Floats:
        return grid_actions(self.rules.cell.paper_chart("a policy on a grid of places"), self.points_mm, not self.rules.external_finish)


FINISH, PASS, PLACE = 0, 1, 2
"""An arm's branches, as the networks have them (``marl_handover.baselines.decentralised``)."""


class TurnsPolicy(NetworkPolicy):
    """Two arms' policies as one supervisor.

    It asks the arm whose turn it is: the other one than that which moved last; L at first. If that arm passes, it asks the other. If both
    pass, nobody would ever move: the answer is not a number.

    Args:
        rules: the rule book to act under.
        name: what it was loaded as.
        arrays: weights, from a policy file: one network for both arms, or one each.
        about: what the file says of them.
    """

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name, arrays, about)
        self.networks = [network_layers(arrays, about, number) for number in range(about["networks"])]

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """What the first arm that does not pass wants: its likeliest branch, and the mean place."""
        logits, places = self._said(pose, goal)
        branch = logits.argmax(-1)
        first = np.where(np.asarray(previous_arm) == 0, 1, 0)
        arm = np.where(select(branch, first) == PASS, 1 - first, first)
        chosen = select(branch, arm)
        return np.where((chosen == PASS)[..., None], math.nan, self._decision(arm, chosen, places))

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All branches of the arm that was to act, the likeliest first, then all of the other one's; nobody passes."""
        logits, places = self._said(pose, goal)
        logits[..., PASS] = -math.inf
        order = np.argsort(-logits, -1, kind="stable")[..., :-1]
        arm = np.where(action[..., 1] > 0, 1, 0)
        ranked = [(asked, np.take_along_axis(order, asked[..., None, None], -2)[..., 0, :]) for asked in (arm, 1 - arm)]
        found = [self._decision(asked, branches[..., rank], places) for asked, branches in ranked for rank in range(branches.shape[-1])]
        return np.stack(found, -2)

    def _said(self, pose: Floats, goal: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Logits (..., arms, 2 + components) of each arm's branches, and its places (..., arms, components, 2) on the table."""
        both = observe(self.rules, "relative", pose, goal, np.full(np.shape(pose)[:-1], NO_ARM)).astype(np.float32)
        blocks = both.reshape(*both.shape[:-1], -1, len(ARM_FIELDS))
        sign = self._sign(blocks)
        out = self._asked(self._harmonics(np.where(sign[..., None] < 0, blocks * self.odd, blocks)))
        components = self.about["modes"]
        places = np.tanh(out[..., PLACE + components : PLACE + 3 * components]).reshape(*out.shape[:-1], components, 2)
        signs = np.stack(np.broadcast_arrays(sign * self.place_sign[:, 0], self.place_sign[:, 1]), -1)
        return out[..., : PLACE + components], places * signs[..., None, :]

    @staticmethod
    def _decision(arm: NDArray[np.int64], branch: NDArray[np.int64], places: NDArray[np.float32]) -> Floats:
        """Actions (..., 4) of branches (...) of arms (...)."""
        own = np.take_along_axis(places, arm[..., None, None, None], -3)[..., 0, :, :]
        place = np.take_along_axis(own, np.asarray(np.maximum(branch - PLACE, 0))[..., None, None], -2)[..., 0, :]
        return np.stack([np.where(branch == FINISH, 1.0, -1.0), 2.0 * arm - 1.0, place[..., 0], place[..., 1]], -1)

    def _asked(self, blocks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Outputs (..., arms, outputs) of each arm's network for its block."""
        if len(self.networks) == 1:
            return self._forward(blocks)
        return np.stack([self._forward(blocks[..., arm, :], layers) for arm, layers in enumerate(self.networks)], -2)
