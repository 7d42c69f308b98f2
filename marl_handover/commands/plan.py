"""``marl-handover plan``: one problem, solved by a policy on the exact kinematics, transfer by transfer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import NO_ARM
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.config import (
    ARCHITECTURES,
    CELL_ALIASES,
    EPSILON_DEG,
    POSE,
    SYMMETRY_ORDER,
    CellConfig,
    MotionConfig,
    NoiseConfig,
    bounded,
    changed,
    check_bounds,
    chosen,
    path_field,
    seed_field,
)
from marl_handover.errors import InvalidSetting, NotFinite, UnknownChoice, WorkFailed, counted
from marl_handover.policies import SupervisorPolicy, adapted
from marl_handover.task.episode import advance
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.rules import Outcome, Rules, Transition

if TYPE_CHECKING:
    from marl_handover.motion.planner import MotionPlanner

OUT_OF_REACH, MOTION = "out_of_reach", "motion"
REASONS = {OUT_OF_REACH: "out of this arm's reach", MOTION: "the policy's motion breaks a limit or collides"}
"""Why transfers are refused here, and how that is said."""


@dataclass
class PlanConfig:
    """Keys of ``plan``. A trained policy brings its own cell and task; what is null here stays as it brought it."""

    start: list[float] = bounded([-120.0, -60.0, 0.0], *POSE)  # x [mm], y [mm], orientation [deg]
    goal: list[float] = bounded([150.0, 60.0, 90.0], *POSE)  # x [mm], y [mm], orientation [deg]
    policy: str = path_field("exact")  # exact, random, greedy, pretrained_a or _b or _twin, a run directory or a policy file
    cell: CellConfig | None = None  # null: the policy's own, or paper; single keys change the paper cell
    architecture: str | None = chosen(None, ARCHITECTURES)  # A or B; null: the policy's own, or B
    epsilon_deg: float | None = bounded(None, *EPSILON_DEG)  # allowed orientation error; null: the policy's own, or 5
    symmetry_order: int | None = bounded(None, *SYMMETRY_ORDER)  # same look when turned by 360/k deg; null: the policy's own, or 1
    seed: int = seed_field()  # of policy=random
    json: str = path_field()  # file for the sequence
    picture: str = path_field()  # file for a picture of the sequence: .png, .pdf or .svg
    motion: str = path_field()  # file for the arms' motions: timed joint trajectories of every transfer
    motion_picture: str = path_field()  # file for a picture of them: .png, .pdf or .svg
    arm_motion: MotionConfig = field(default_factory=MotionConfig)  # how the arms move, for motion and motion_picture
    progress: bool = True  # of what takes long, on stderr


SCHEMA: type = PlanConfig
ALIASES = CELL_ALIASES
GROUPS: dict[str, dict[str, type]] = {}


def run(config: PlanConfig) -> int:
    """Solve, print, write. Raises :class:`WorkFailed` if the policy does not reach the goal."""
    planned(config, print)
    return 0


def planned(config: PlanConfig, say: Callable[[str], None]) -> dict[str, Any]:
    """Solve, say how, write, and return what ``json=FILE`` gets. Raises :class:`WorkFailed` if the policy does not reach the goal."""
    from marl_handover.report.figure_style import require_picture, save_figure, write_json

    for name in ("picture", "motion_picture"):
        if getattr(config, name):
            require_picture(name, getattr(config, name))
    for name in ("json", "picture", "motion", "motion_picture"):
        if getattr(config, name) and Path(getattr(config, name)).is_dir():
            raise InvalidSetting(name, getattr(config, name), "a file, not a folder")
    check_bounds(config)
    poses = {name: _pose(name, getattr(config, name)) for name in ("start", "goal")}
    policy = _policy(config)
    rules = policy.rules
    for name, pose in poses.items():
        rules.cell.require_reached(name, pose)
    planner = _planner(config, policy)
    plan = solve(policy, poses["start"], poses["goal"])
    say(_text(plan, rules))
    if planner is not None:
        _move(config, plan, planner, say)  # first: if there is no motion, nothing is written
    if config.json:
        write_json(Path(config.json), plan)
    if config.picture:
        from marl_handover.report.plan import plan_figure

        save_figure(plan_figure(plan, rules.cell), Path(config.picture), "picture")
    if plan["outcome"] != Outcome.SUCCESS.name.lower():
        waiting = "; no arm moves any more" if plan["waiting"] else ""
        made = counted(len(plan["transfers"]), "transfer")
        raise WorkFailed(f"policy {policy.name!r} did not reach the goal: {plan['outcome']} after {made}{waiting}")
    return plan


def _move(config: PlanConfig, plan: dict[str, Any], planner: MotionPlanner, say: Callable[[str], None]) -> None:
    """Plan the motion of every transfer that was not refused, say what it is, and write it as file and picture.

    Raises:
        NoMotion: if one of them has no collision-free motion; then nothing is written.
    """
    from marl_handover.motion.coordination import coordinate
    from marl_handover.report.figure_style import save_figure, write_json
    from marl_handover.report.motion import motion_row, plan_motions

    planner.warm_up()
    done = [transfer for transfer in plan["transfers"] if not transfer["refused"]]
    labels = planner.model.cell.labels
    orders = [(labels.index(t["arm"]), np.array(t["from"][:2]), np.array(t["to"][:2])) for t in done]
    motions = plan_motions(planner, orders)
    nearest = "the other arm" if len(labels) == 2 else "other arms"
    for number, motion in enumerate(motions, start=1):
        say(
            f"motion {number}: arm {labels[motion.arm]}, {motion.duration_s:.2f} s, grip path {motion.path_length_mm:.1f} mm, "
            f"clearance to {nearest} {motion.min_clearance_mm:.1f} mm, planned in {motion.planning_ms:.1f} ms"
        )
    schedule = coordinate(planner, motions)
    if len(motions) > 1:
        say(
            f"one after another {schedule.sequential_s:.2f} s; with the next arm setting out as early as the clearance allows "
            f"{schedule.overlapped_s:.2f} s, {100 * schedule.saved:.0f} % less"
        )
    if config.motion:
        settings = {"cell_settings": asdict(planner.model.cell.config), "motion_settings": asdict(planner.motion)}
        write_json(Path(config.motion), {**settings, "transfers": [motion_row(motion, labels) for motion in motions]})
    if config.motion_picture:
        from marl_handover.report.motion import motion_figure

        save_figure(motion_figure(motions, planner.model, planner.motion), Path(config.motion_picture), "motion_picture")


def _planner(config: PlanConfig, policy: SupervisorPolicy) -> MotionPlanner | None:
    """The arms' planner; None if no motion is asked for. Refuses settings it cannot use, under their key here, ``arm_motion``.

    Raises:
        InvalidSetting: also for motions of a policy that makes its own: the planner's would be others.
    """
    for name in ("motion", "motion_picture"):
        if getattr(config, name) and policy.variant == "centralised":
            raise InvalidSetting(name, getattr(config, name), "left out with a centralised policy, whose motions are its own")
    if not (config.motion or config.motion_picture):
        for key, value in changed("arm_motion", config.arm_motion):
            raise InvalidSetting(key, value, "left out without motion=FILE or motion_picture=FILE")
        return None
    # The planner is imported here: without motions, this command compiles none of its functions.
    from marl_handover.cell import build_whole_cell
    from marl_handover.motion.planner import MotionPlanner

    try:
        return MotionPlanner(build_whole_cell(policy.rules.cell.config), config.arm_motion)
    except InvalidSetting as error:
        key = f"arm_{error.name}" if error.name.startswith("motion.") else error.name
        raise InvalidSetting(key, error.value, error.limit) from error
    except UnknownChoice as error:
        raise UnknownChoice(f"arm_{error.name}", error.value, error.choices) from error


def solve(policy: SupervisorPolicy, start: Floats, goal: Floats) -> dict[str, Any]:
    """What the policy does with one problem, poses (3,), on exact kinematics: the content of ``plan … json=FILE``, mm and rad.

    ``waiting`` says that it ended in a time-out because no arm is to move any more.
    """
    rules = policy.rules
    pose, outcome = start, Outcome.NONE
    previous: Any = np.int64(NO_ARM)
    transfers: list[dict[str, Any]] = []
    waiting, over = False, False
    while not over:
        action = policy.act(pose, goal, previous)
        stepped = advance(rules, pose, goal, previous, action, np.int64(len(transfers)), may_wait=True)
        result, over, waiting = stepped.result, bool(stepped.over), bool(stepped.idle)
        outcome = Outcome(int(stepped.outcome))
        if waiting:
            break
        external = int(result.external_arm)
        if int(result.transfers) > (external >= 0):
            transfers.append(_commanded(rules, pose, goal, result))
        if external >= 0:
            path_mm = float(rules.motion_cost(rules.cell, np.int64(external), result.placed[:2], result.pose[:2]))
            transfers.append(_transfer(rules, external, None, result.placed, result.pose, path_mm, None))
        pose, previous = result.pose, result.previous_arm
    planner = ExactPlanner(rules)
    optimum = int(planner.plan(start, goal).transfers)
    return {
        "policy": policy.name,
        "architecture": rules.config.architecture,
        "cell": rules.cell.config.name,
        "start": start.tolist(),
        "goal": goal.tolist(),
        "epsilon_deg": rules.config.epsilon_deg,
        "symmetry_order": rules.config.symmetry_order,
        "optimal_transfers": optimum or None,
        **({} if optimum else {"unsolvable_because": planner.unsolvable_because(start, goal)}),
        "outcome": outcome.name.lower(),
        "transfers": transfers,
        "waiting": waiting,
        "total_path_mm": sum(transfer["path_mm"] for transfer in transfers),
        "orientation_error_deg": math.degrees(rules.orientation_error(pose[2], goal[2])),
        "cell_settings": asdict(rules.cell.config),
    }


def _commanded(rules: Rules, pose: Floats, goal: Floats, result: Transition) -> dict[str, Any]:
    """The entry of the policy's own transfer."""
    command, feasible = result.command, bool(result.feasible)
    motion = getattr(command, "motion", None)  # of a policy that makes its motions itself
    if motion is None or not feasible:
        path_mm = float(rules.motion_cost(rules.cell, command.arm, pose[:2], result.placed[:2]))
    else:
        ways = (np.asarray(part)[None] for part in (command.arm, pose[:2], result.placed[:2], motion))
        path_mm = float(rules.path_mm(*ways)[0])  # type: ignore[attr-defined]
    refusal = None
    if not feasible:
        reached = bool(Rules.transfer(rules, pose, goal, command)[1])
        refusal = MOTION if reached else OUT_OF_REACH
    receiver = None if command.final else int(command.receiver)
    return _transfer(rules, int(command.arm), receiver, pose, result.placed, path_mm, refusal)


def _transfer(
    rules: Rules, arm: int, receiver: int | None, before: Floats, after: Floats, path_mm: float, refusal: str | None
) -> dict[str, Any]:
    """One entry of ``transfers``. A final transfer goes to the goal, not to a place of the chart: no receiver, no alpha and beta."""
    labels, alpha, beta = rules.cell.labels, None, None
    if receiver is not None and refusal is None:
        space = rules.cell.graph.edges[min(arm, receiver), max(arm, receiver)]
        alpha, beta = (float(value) for value in space.from_table(after[:2]))
    named = {} if labels == ARM_LETTERS else {"receiver": None if receiver is None else labels[receiver]}
    return {
        "arm": labels[arm],
        **named,
        "final": receiver is None,
        "from": before.tolist(),
        "to": after.tolist(),
        "alpha": alpha,
        "beta": beta,
        "path_mm": path_mm,
        "refused": refusal is not None,
        "refusal": refusal,
    }


def _pose(name: str, values: list[float]) -> Floats:
    """The pose (3,) in mm and rad of x [mm], y [mm], orientation [deg]."""
    if len(values) != 3:
        raise InvalidSetting(name, values, f"three numbers, {name}=[x_mm,y_mm,deg]")
    if not all(math.isfinite(value) for value in values):
        raise NotFinite(name, values)
    return np.array([values[0], values[1], wrap(math.radians(values[2]))], float)


def _policy(config: PlanConfig) -> SupervisorPolicy:
    """The policy under its own cell and task, except where ``config`` says otherwise."""
    named = {key: getattr(config, key) for key in ("architecture", "epsilon_deg", "symmetry_order")}
    # The rules are exact here: noise that a policy was trained with would only widen what counts as "at the goal".
    return adapted(config.policy, config.cell, seed=config.seed, **named, noise=NoiseConfig())


def _text(plan: dict[str, Any], rules: Rules) -> str:
    """The sequence as a table, in mm and deg."""
    goal_theta, width = plan["goal"][2], max(3, *map(len, rules.cell.labels))
    lines = [
        f"policy {plan['policy']}, architecture {plan['architecture']}, cell {plan['cell']}, epsilon {plan['epsilon_deg']:g} deg",
        f"{'step':>4}  {'arm':<{width}}  final  {'x [mm]':>8} {'y [mm]':>8} {'theta [deg]':>12} {'to goal [deg]':>14} {'path [mm]':>10}"
        "  alpha, beta",
    ]

    def row(step: str, arm: str, final: str, pose: list[float], path: str = "", note: str = "") -> str:
        left = math.degrees(rules.orientation_error(pose[2], goal_theta))
        x, y, theta = pose[0], pose[1], math.degrees(pose[2])
        return f"{step:>4}  {arm:<{width}}  {final:<5}  {x:z8.1f} {y:z8.1f} {theta:z12.2f} {left:z14.2f} {path:>10}  {note}".rstrip()

    lines.append(row("0", "", "", plan["start"], note="start"))
    for number, transfer in enumerate(plan["transfers"], start=1):
        place = "" if transfer["alpha"] is None else f"{transfer['alpha']:+z.3f}, {transfer['beta']:+z.3f}"
        if transfer.get("receiver") is not None:
            place = f"{place} towards {transfer['receiver']}".strip()
        note = f"refused: {REASONS[transfer['refusal']]}" if transfer["refused"] else place
        path = f"{transfer['path_mm']:.1f}"
        lines.append(row(str(number), transfer["arm"], "yes" if transfer["final"] else "no", transfer["to"], path, note))
    lines.append(row("goal", "", "", plan["goal"]))
    optimum = "none within the limit" if plan["optimal_transfers"] is None else plan["optimal_transfers"]
    lines.append(
        f"{plan['outcome']}: {counted(len(plan['transfers']), 'transfer')} (optimum {optimum}), path {plan['total_path_mm']:.1f} mm, "
        f"orientation error {abs(plan['orientation_error_deg']):.2f} deg"
    )
    if plan["optimal_transfers"] is None:
        lines.append(f"unsolvable: {plan['unsolvable_because']}")
    return "\n".join(lines)
