"""A referee for traces: replays every step from the definitions, and compares the number of transfers with the fewest by brute force."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field

import numpy as np

from tests.oracles.angle_sums import AngleSums
from tests.oracles.layouts import Layout, wrapped

CERTAIN_MM, CLEARLY_MM = 5e-4, 4e-3
"""Reach has a tolerance of 1 um in the radius, and a little more sideways: between these, outside, either answer is right."""

ANGLE_RAD = 1e-7
EPSILON_BAND_RAD = 2e-5
"""Of an error so near to epsilon either verdict is right; a success is never further beyond it."""

REWARDS_B = {"success": 20.0, "wrong_orientation": -30.0, "wrong_position": -30.0, None: -1.0, "timeout": -1.0}


@dataclass
class Verdicts:
    """What the referee found; ``wrong`` in words, numbers one an episode, 0 transfers for an episode without success."""

    wrong: list[str] = field(default_factory=list)
    steps: int = 0
    transfers: list[int] = field(default_factory=list)
    at_least: list[int] = field(default_factory=list)  # no plan is shorter; 0: no plan at all
    at_most: list[int] = field(default_factory=list)  # a plan of so many is known; 0: none is

    @property
    def ratio(self) -> float:
        """Mean of transfers / optimum over successful episodes; a replayed success is a known plan too."""
        pairs = [(made, min(made, known or made)) for made, known in zip(self.transfers, self.at_most, strict=True) if made]
        return float(np.mean([made / best for made, best in pairs]))


def referee(problems, trace, max_steps=20, pair=None):
    """Verdicts on a trace, lines as dicts, of the problems, lines as dicts too; ``pair``: the layout of problems without arms."""
    verdicts, episodes = Verdicts(), {}
    for row in trace:
        episodes.setdefault(row["episode"], []).append(row)
    if unknown := set(episodes) - set(range(len(problems))):
        verdicts.wrong.append(f"episodes {sorted(unknown)} belong to no problem")
    groups = {}
    for number, problem in enumerate(problems):
        groups.setdefault(json.dumps([problem.get("arms"), problem.get("obstacles", [])]), []).append(number)
    made = dict.fromkeys(range(len(problems)), 0)
    bounds = {}
    for key, numbers in groups.items():
        arms, obstacles = json.loads(key)
        layout = Layout(arms, obstacles) if arms else pair
        sums = AngleSums(layout)
        for number in numbers:
            rows = episodes.get(number, [])
            made[number] = _Episode(layout, problems[number], rows, max_steps, number, verdicts.wrong).replayed()
            verdicts.steps += len(rows)
        epsilon = next((row["epsilon_rad"] for number in numbers for row in episodes.get(number, [])), math.radians(5))
        start, goal = (np.array([problems[number][name] for number in numbers], float) for name in ("state", "goal"))
        for number, *both in zip(
            numbers, *(sums.fewest(start, goal, epsilon, max_steps, outer=outer) for outer in (True, False)), strict=True
        ):
            bounds[number] = both
    for number in range(len(problems)):
        verdicts.transfers.append(made[number])
        verdicts.at_least.append(int(bounds[number][0]))
        verdicts.at_most.append(int(bounds[number][1]))
    return verdicts


def judged_exact(verdicts):
    """Complaints about a trace that claims to be optimal: the wrong steps, and every episode that is not among the shortest."""
    said = list(verdicts.wrong)
    for number, (made, least, most) in enumerate(zip(verdicts.transfers, verdicts.at_least, verdicts.at_most, strict=True)):
        if made and (least == 0 or made < least):
            said.append(f"episode {number}: {made} transfers, below the optimum {least}")
        if most and (made == 0 or made > most):
            said.append(f"episode {number}: {made or 'no'} transfers, {most} are enough")
    return said


class _Episode:
    """One problem and its lines."""

    def __init__(self, layout, problem, rows, max_steps, number, wrong):
        self.layout, self.problem, self.rows, self.max_steps, self.number, self.wrong = layout, problem, rows, max_steps, number, wrong
        self.names = [arm["name"] for arm in layout.arms]
        self.step = 0

    def expect(self, holds, words):
        if not holds:
            self.wrong.append(f"episode {self.number}, step {self.step}: {words}")

    def replayed(self):
        """Check every line; the number of transfers if the episode ends in a success, else 0."""
        pose, previous = np.array(self.problem["state"], float), None
        pose[2] = wrapped(pose[2])
        for step, row in enumerate(self.rows):
            self.step = step
            self.expect(row["step"] == self.step, f"is numbered {row['step']}")
            self.expect(np.allclose(row["state"][:2], pose[:2], atol=1e-9, rtol=0), f"starts at {row['state']}, the object is at {pose}")
            self.expect(abs(wrapped(row["state"][2] - pose[2])) < ANGLE_RAD, f"starts turned by {row['state'][2]}, the object by {pose[2]}")
            goal = np.array(row["goal"], float)
            apart = np.abs([*(goal[:2] - self.problem["goal"][:2]), wrapped(goal[2] - self.problem["goal"][2])])
            self.expect((apart < 1e-9).all(), f"has the goal {row['goal']}, not the problem's")
            self.expect(row["previous_arm"] == previous, f"says previous_arm {row['previous_arm']}, it was {previous}")
            feasible = self._transfer(row, pose, goal)
            self._judge(row, pose, goal, feasible)
            pose = np.array(row["next_state"], float)
            previous = row["arm"] if feasible else previous
            over = row["terminated"] or row["truncated"]
            self.expect(over == (self.step == len(self.rows) - 1), "the episode ends elsewhere than its lines")
        return len(self.rows) if self.rows and self.rows[-1]["outcome"] == "success" else 0

    def _transfer(self, row, pose, goal):
        """Check who moves what where; whether the arm could."""
        self.expect(row["arm"] in self.names, f"arm {row['arm']!r} is none of {self.names}")
        arm = self.names.index(row["arm"])
        place = np.array(row["place"], float)
        self.expect(max(abs(row["alpha"]), abs(row["beta"])) <= 1, f"chart point {row['alpha'], row['beta']}")
        margins = [float(self.layout.margin(place, [arm])[0]), float(self.layout.margin(pose, [arm])[0])]
        if row["final"]:
            self.expect(np.allclose(place, goal[:2], atol=1e-9, rtol=0), f"final, but to {place}")
        elif self.layout.count != 2 or "receiver" in row:
            receiver = row["receiver"]
            self.expect(receiver in self.names and receiver != row["arm"], f"receiver {receiver!r} of {row['arm']!r}")
            margins.append(float(self.layout.margin(place, [self.names.index(receiver)])[0]))
        else:
            margins.append(float(self.layout.margin(place, [1 - arm])[0]))
        stays = np.allclose(row["next_state"], pose, atol=1e-9, rtol=0)
        feasible = min(margins) >= -CERTAIN_MM or (min(margins) >= -CLEARLY_MM and not stays)
        if not feasible:
            self.expect(stays, f"arm {row['arm']!r} cannot do this, margins {margins} mm, and the object still moves")
            return False
        turn = float(np.diff(self.layout.psi(np.stack([pose[:2], place]))[:, arm])[0])
        self.expect(
            np.allclose(row["next_state"][:2], place, atol=1e-9, rtol=0), f"leaves the object at {row['next_state']}, not at {place}"
        )
        off = float(wrapped(row["next_state"][2] - pose[2] - turn))
        self.expect(abs(off) < ANGLE_RAD, f"turns the object {off} rad too far")
        self.expect(abs(row["next_state"][2]) <= math.pi + 1e-6, "orientation is not wrapped")
        return True

    def _judge(self, row, pose, goal, feasible):
        """Check outcome, reward and end."""
        after, epsilon = np.array(row["next_state"], float), row["epsilon_rad"]
        error = abs(float(wrapped((after[2] - goal[2]) * row["symmetry_order"]))) / row["symmetry_order"]
        expected = [None]
        if row["final"]:
            expected = ["success" if error <= epsilon else "wrong_orientation"] if feasible else ["wrong_position"]
            if abs(error - epsilon) < EPSILON_BAND_RAD and feasible:
                expected = ["success", "wrong_orientation"]
        elif not feasible and row["architecture"] == "B":
            expected = ["wrong_position"]
        ends = expected != [None]
        if not ends and self.step + 1 >= self.max_steps:
            expected = ["timeout"]
        self.expect(row["outcome"] in expected, f"outcome {row['outcome']}, expected {' or '.join(map(str, expected))}")
        self.expect(row["terminated"] == ends, f"terminated {row['terminated']}")
        self.expect(row["truncated"] == (expected == ["timeout"]), f"truncated {row['truncated']}")
        if row["architecture"] == "B":
            rewards = {REWARDS_B[row["outcome"]]}
        elif row["final"]:
            rewards = {0.0}
        else:
            rewards = (
                self._finishable(after, goal, epsilon) if self.step + 1 < self.max_steps else {-1.0}
            )  # no transfer is left to finish with
        self.expect(row["reward"] in rewards, f"reward {row['reward']}, expected {rewards}")

    def _finishable(self, pose, goal, epsilon):
        """Rewards that architecture A may give for leaving the object at ``pose``."""
        psi = self.layout.psi(np.stack([pose, goal]))
        error = np.abs(wrapped(pose[2] + psi[1] - psi[0] - goal[2]))
        margin = np.minimum(self.layout.margin(pose), self.layout.margin(goal))
        if ((error <= epsilon - EPSILON_BAND_RAD) & (margin >= 0)).any():
            return {0.0}
        return {0.0, -1.0} if ((error <= epsilon + EPSILON_BAND_RAD) & (margin >= -CLEARLY_MM)).any() else {-1.0}
