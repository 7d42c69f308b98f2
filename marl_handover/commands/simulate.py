"""``marl-handover simulate``: episodes in simulated physics, to read and to watch. Each ends at the first verdict."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from marl_handover import policies
from marl_handover.arrays import Floats, wrap
from marl_handover.cell import build_whole_cell
from marl_handover.config import (
    CELL_ALIASES,
    ENGINES,
    POSE,
    CellConfig,
    MotionConfig,
    TaskChanges,
    bounded,
    check_bounds,
    chosen,
    path_field,
    seed_field,
)
from marl_handover.errors import InvalidSetting, WorkFailed, counted
from marl_handover.policies.policy import NobodyMoves
from marl_handover.progress import Bar
from marl_handover.task.rules import Outcome

if TYPE_CHECKING:
    from marl_handover.envs.handover_aec import HandoverEnv
    from marl_handover.motion.executor import ExecutorAgent
    from marl_handover.simulation.backend import PhysicsBackend
    from marl_handover.simulation.film import Film
    from marl_handover.task.rules import Rules


@dataclass
class SimulateCommand:
    """Settings of ``simulate``. What is not given is the policy's own, or the default."""

    policy: str = path_field("exact")  # exact, random, greedy, pretrained_a or _b or _twin, a run directory or a policy file
    episodes: int = bounded(1, 1, 10**6)  # played one after the other; each ends at the first verdict
    seed: int = seed_field()  # of the problems
    start: list[float] | None = bounded(None, *POSE)  # x [mm], y [mm], orientation [deg]; null: random
    goal: list[float] | None = bounded(None, *POSE)  # the same; null: random
    cell: CellConfig | None = None  # single keys change the paper cell
    task: TaskChanges = field(default_factory=TaskChanges)  # but for the noise: physics decides
    motion: MotionConfig = field(default_factory=MotionConfig)
    engine: str | None = chosen(None, ENGINES)  # bullet or mujoco; null: bullet where it is installed
    grasp: str | None = chosen(None, ("friction", "constraint"))  # of two pads; constraint: a rigid joint while both are on the pin
    video: str = path_field()  # .mp4 or .gif
    fps: float = bounded(12.5, 1.0, 50.0)  # of the video, in simulated time
    size: list[int] = bounded([640, 480], 16, 4096, (2, 2))  # of the video: width, height in pixels
    view: str = chosen("overview", ("overview", "top"))  # of the video: overview, or top (the cell's camera)
    captions: bool = True  # of the video: transfer, arm and error below the picture, what the arms reach on the table
    gui: bool = False  # open the engine's window
    progress: bool = True


SCHEMA = SimulateCommand
ALIASES = CELL_ALIASES | {key: f"task.{key}" for key in ("epsilon_deg", "architecture", "max_steps")}
GROUPS: dict[str, dict[str, type]] = {}


class Played(NamedTuple):
    """An episode: how it ended, and what it took."""

    outcome: str
    transfers: int
    simulated_s: float
    wall_s: float


def run(config: SimulateCommand) -> int:
    """Play, print, write. Raises :class:`WorkFailed` if an episode misses its goal."""
    from marl_handover.simulation.backend import PhysicsBackend
    from marl_handover.simulation.camera import view
    from marl_handover.simulation.film import picture_size

    _check(config)
    size = picture_size((config.size[0], config.size[1]), config.captions)
    policy = policies.adapted(config.policy, config.cell, config.seed, **vars(config.task))
    policy.require_executors()
    for name in ("start", "goal"):
        if (pose := getattr(config, name)) is not None:
            policy.rules.cell.require_reached(name, pose)
    model = build_whole_cell(policy.rules.cell.config)
    camera = view(config.view, model.cell)
    backend = PhysicsBackend(model, config.motion, engine=config.engine, grasp=config.grasp, gui=config.gui, camera=camera, size=size)
    for note in backend.notes:
        print(note, file=sys.stderr)
    try:
        with _recording(config, backend, policy.rules) as film:
            played = list(_episodes(config, policy, model, backend, film))
    finally:
        backend.close()
    failed = [episode.outcome for episode in played if episode.outcome != "success"]
    simulated, wall = sum(p.simulated_s for p in played), sum(p.wall_s for p in played)
    print(f"{len(played) - len(failed)} of {counted(len(played), 'episode')} reached the goal; {simulated:.1f} s simulated in {wall:.1f} s")
    if failed:
        raise WorkFailed(f"policy {config.policy!r} did not reach the goal: {', '.join(sorted(set(failed)))}")
    return 0


def _check(config: SimulateCommand) -> None:
    """Raise for settings that cannot be, before anything is built."""
    from marl_handover.simulation.film import picture_size
    from marl_handover.simulation.video import require_video

    check_bounds(config)
    if not all(side % 2 == 0 for side in config.size):
        raise InvalidSetting("size", list(config.size), "two even numbers of pixels, 16 to 4096: [width, height]")
    if picture_size((config.size[0], config.size[1]), config.captions)[1] < 8:
        raise InvalidSetting("size", list(config.size), "higher, to have room for the words below the picture; or captions=false")
    if config.task.noise is not None:
        raise InvalidSetting("task.noise", asdict(config.task.noise), "left out: physics decides")
    config.motion.validate()
    if config.video:
        require_video("video", config.video)


@contextmanager
def _recording(config: SimulateCommand, backend: PhysicsBackend, rules: Rules) -> Iterator[Film | None]:
    """The film, if a video is asked for."""
    if not config.video:
        yield None
        return
    from marl_handover.simulation.film import filming

    size = (config.size[0], config.size[1])
    with filming(config.video, config.fps, backend, size, config.captions, rules.orientation_error) as film:
        yield film
    print(f"written: {config.video}")


def _episodes(
    config: SimulateCommand, policy: policies.SupervisorPolicy, model: Any, backend: PhysicsBackend, film: Film | None
) -> Iterator[Played]:
    from marl_handover.envs.handover_aec import raw_env
    from marl_handover.motion.executor import ExecutorAgent

    enabled = policy.rules.cell.config.enabled
    env = raw_env(backend=backend, cell=model, task=policy.rules.config, motion=config.motion, enabled=enabled)
    supervisor = policy.under(env.rules)
    arms = {agent: ExecutorAgent(agent, model, motion=config.motion) for agent in env.arm_agents}
    problem = {}
    for key, given in (("state", config.start), ("goal", config.goal)):
        if given is not None:
            problem[key] = [given[0], given[1], float(wrap(math.radians(given[2])))]
    with Bar(total=config.episodes, unit="episode", shown=config.progress, leave=False) as bar:
        for episode in range(config.episodes):
            env.reset(seed=config.seed if episode == 0 else None, options=problem or None)
            goal = env.observe("supervisor")["goal"]
            if film is None:
                backend.cell.show_goal(goal)
            else:
                film.begin(goal)
            played = play(env, supervisor, arms, backend, lambda line: bar.write(line), film)
            if film is not None:
                film.end(played.outcome)
            yield played
            bar.update()


def play(
    env: HandoverEnv,
    supervisor: policies.SupervisorPolicy,
    arms: dict[str, ExecutorAgent],
    backend: PhysicsBackend,
    say: Callable[[str], None],
    film: Film | None = None,
) -> Played:
    """Play one episode from where ``env`` was reset to; ``say`` gets one line a transfer, ``film`` is told whose turn it is."""
    simulated, began, stopped = 0.0, time.perf_counter(), False
    goal, labels = env.observe("supervisor")["goal"], env.model.cell.labels
    say(f"object {_pose(backend.cell.object_pose())} to goal {_pose(goal)}")
    while not (env.terminations["supervisor"] or env.truncations["supervisor"]):
        agent = env.agent_selection
        observation = env.observe(agent)
        if agent == "supervisor":
            try:
                env.step(supervisor(observation))
            except NobodyMoves as stop:
                say(f"  {stop.why or 'no arm is to move any more'}")
                stopped = True
                break
            continue
        if film is not None:
            film.turn(arms[agent].arm, bool(observation["final"]))
        started, backend.last = time.perf_counter(), None
        action = arms[agent].act(observation)
        env.step(action)
        seconds = 0.0 if backend.last is None else backend.last.duration_s
        simulated += seconds
        refusal = env.infos[agent]["refusal"]
        came = "done" if refusal is None else f"{refusal}{_reason(arms[agent])}"
        rate = seconds / (time.perf_counter() - started)
        say(
            f"  {labels[arms[agent].arm]} to ({observation['target'][0]:z.1f} mm, {observation['target'][1]:z.1f} mm): {came}; "
            f"object {_pose(backend.cell.object_pose())}; {seconds:.1f} s, {rate:.1f} x real time"
        )
    infos = env.infos["supervisor"]  # empty at the reset
    outcome = Outcome.TIMEOUT.name.lower() if stopped else str(infos["outcome"])
    played = Played(outcome, int(infos.get("transfers", 0)), simulated, time.perf_counter() - began)
    say(f"{outcome} after {counted(played.transfers, 'transfer')}")
    return played


def _reason(arm: ExecutorAgent) -> str:
    return "" if arm.last_refusal is None else f" ({arm.last_refusal})"


def _pose(pose: Floats) -> str:
    return f"({pose[0]:z.1f} mm, {pose[1]:z.1f} mm, {math.degrees(pose[2]):z.1f} deg)"
