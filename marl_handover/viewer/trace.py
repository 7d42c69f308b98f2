"""The page of a trace: scrub through it, or play it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import CellModel
from marl_handover.config import MotionConfig, TaskConfig
from marl_handover.control.interactive.world_state import lying
from marl_handover.errors import HandoverError
from marl_handover.motion.planner import MotionPlanner, grasp_joints
from marl_handover.motion.trajectory import LOADED_PHASES
from marl_handover.task.rules import Rules
from marl_handover.viewer.scene import CellScene
from marl_handover.viewer.trace_file import Moment, Recorded, Step, Trace
from marl_handover.viewer.words import arm_words, by_hand, degrees_words, error_words, number, place_words, plain, write

STRAIGHT_S = 1.5
_STRAIGHT_SAMPLES = 31
_OPEN_MM = 0.5
"""Fingers that have come together by more than this from their widest in a transfer are closing on the pin."""


class Motion(NamedTuple):
    """A transfer, sampled.

    ``t_s`` (m,) from 0 on; ``joints_rad`` (m, n, 5); ``grip_open`` (m, n); ``T_world_block`` (m, 4, 4) in mm.
    """

    t_s: Floats
    joints_rad: Floats
    grip_open: NDArray[np.bool_]
    T_world_block: Floats

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return float(self.t_s[-1])

    def at(self, t_s: float) -> int:
        """The sample at a time."""
        return int(np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 1))


class Motions:
    """The motions of a trace's steps, made in another thread when they are asked for; the latest are kept.

    Args:
        model: the cell.
        motion: how the arms move.
        kept: how many.
    """

    def __init__(self, model: CellModel, motion: MotionConfig | None = None, kept: int = 32) -> None:
        self.model, self._kept = model, kept
        self.planner = MotionPlanner(model.without_obstacles(), motion)
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="motions")
        self._made: OrderedDict[int, Future[Motion]] = OrderedDict()

    def close(self) -> None:
        """Make no more."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def ask(self, number: int, step: Step) -> Future[Motion]:
        """The motion of a step, now or soon."""
        future = self._made.get(number)
        if future is None or future.cancelled():
            while len(self._made) >= self._kept:
                self._made.popitem(last=False)[1].cancel()
            future = self._made[number] = self._worker.submit(self._make, step)
        self._made.move_to_end(number)
        return future

    def placed(self, step: Step) -> Floats:
        """Joints (n, 5) of the arms as a transfer ends: the one holds what it has put down, if it has; the others are parked."""
        joints = self.planner.homes_rad.copy()
        if not step.trouble:
            with suppress(HandoverError):  # put down beyond what exact arms reach
                joints[step.arm] = grasp_joints(self.model, step.arm, "place", step.next_state[:2])
        return joints

    def _make(self, step: Step) -> Motion:
        with suppress(HandoverError, ArithmeticError, LookupError, ValueError):  # a place that exact arms do not reach, another cell's arms
            if step.recorded is not None:
                return self._as_recorded(step, step.recorded)
            if not step.trouble:
                return self._planned(step)
        return self._straight(step)

    def _planned(self, step: Step) -> Motion:
        planner = self.planner
        own_rad, others_rad = planner.homes_rad[step.arm], planner.others_home_rad(step.arm)
        planned = planner.pick_place(step.arm, step.state[:2], step.next_state[:2], own_rad, others_rad)
        names = [phase.name for phase in planned.phases for _ in phase.t_s]
        own = np.concatenate([phase.joints_rad for phase in planned.phases])
        held = np.array([name in LOADED_PHASES for name in names])
        opened = np.concatenate([phase.gripper_mm for phase in planned.phases]) > planner.motion.finger_travel_mm / 2
        joints = np.tile(planner.homes_rad, (len(own), 1, 1))
        joints[:, step.arm] = own
        grips = np.ones((len(own), self.model.cell.num_arms), bool)
        grips[:, step.arm] = opened
        t_s = np.concatenate([phase.t_s for phase in planned.phases])
        return Motion(t_s - t_s[0], joints, grips, self._carried(step, own, held))

    def _as_recorded(self, step: Step, recorded: Recorded) -> Motion:
        fingers = recorded.gripper_mm
        opened = fingers >= fingers.max(0) - _OPEN_MM
        held = ~opened[:, step.arm] & (not step.trouble)
        return Motion(recorded.t_s, recorded.joints_rad, opened, self._carried(step, recorded.joints_rad[:, step.arm], held))

    def _straight(self, step: Step) -> Motion:
        """The block slides by itself, or stays if nothing came of the transfer."""
        share = np.linspace(0.0, 1.0, _STRAIGHT_SAMPLES)
        turn = np.angle(np.exp(1j * (step.next_state[2] - step.state[2])))
        poses = step.state + share[:, None] * np.array([*(step.next_state[:2] - step.state[:2]), turn])
        joints = np.tile(self.planner.homes_rad, (len(share), 1, 1))
        grips = np.ones(joints.shape[:2], bool)
        return Motion(STRAIGHT_S * share, joints, grips, np.stack([lying(pose) for pose in poses]))

    def _carried(self, step: Step, own: Floats, held: NDArray[np.bool_]) -> Floats:
        """T_world_block (m, 4, 4): where it was, then with the hand for as long as that is closed, then where it came to lie."""
        T = np.tile(lying(step.next_state), (len(own), 1, 1))
        inside = np.flatnonzero(held)
        first = int(inside[0]) if len(inside) else len(own)
        T[: min(first, len(own) - 1)] = lying(step.state)
        if len(inside):
            T_world_grip = self.model.cell.bases[step.arm].matrix() @ self.model.arms[step.arm].fk(own)
            T[held] = T_world_grip[held] @ np.linalg.inv(T_world_grip[first]) @ lying(step.state)
        return T


SPEEDS = (0.25, 20.0)
PAUSE_S = 0.6
"""Between the end of an episode and the start of the next."""

INTRO = "Drag the slider, or press play. Numbered ghosts are where the block was put down; the black ghost is the goal."
RESULTS = {
    "success": "**success**",
    "wrong_orientation": "ended **wrongly turned**",
    "wrong_position": "ended at a **wrong place**",
    "timeout": "ended: **too many transfers**",
}
STUCK = "ended: **the policy wanted no arm to move**"


class TracePage:
    """Shows one trace. All work for a moment is for that moment only, however long the trace is.

    Args:
        server: of the page.
        model: the cell it was recorded in.
        trace: all of it.
        task: by whose symmetry errors are told.
        motion: how the arms move where the trace does not say.
        speed: simulated seconds in one second, while it plays.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        model: CellModel,
        trace: Trace,
        task: TaskConfig | None = None,
        motion: MotionConfig | None = None,
        speed: float = 1.0,
    ) -> None:
        self.server, self.trace = server, trace
        self.scene, self.motions = CellScene(server, model), Motions(model, motion)
        self.rules = Rules(model.cell, task or TaskConfig())
        self._lock = threading.Lock()
        self._wanted: int | None = 0
        self._number, self._playing, self._time_s = 0, False, 0.0
        self._moving: Future[Motion] | None = None
        self._add_controls(speed)

    def close(self) -> None:
        """End what goes on in other threads."""
        self.motions.close()

    def update(self, dt_s: float) -> None:
        """Let ``dt_s`` seconds of wall time pass, and show how things are."""
        with self._lock:
            wanted, self._wanted = self._wanted, None
        if wanted is not None:
            self._moving, self._time_s = None, 0.0
            self._go_to(wanted)
        elif self._playing:
            self._play_on(dt_s * number(self._speed, *SPEEDS))

    def want(self, number: int) -> None:
        """Show moment ``number`` next; from any thread."""
        with self._lock:
            self._wanted = int(np.clip(number, 0, self.trace.moments - 1))

    def _add_controls(self, speed: float) -> None:
        gui, last = self.server.gui, self.trace.moments - 1
        gui.add_markdown(INTRO)
        self._text = gui.add_markdown("")
        self._slider = gui.add_slider("moment", min=0, max=last, step=1, initial_value=0)
        self._episode = gui.add_number("episode", 0, min=0, max=self.trace.episodes - 1, step=1)
        self._play = gui.add_button("play")
        previous, following = gui.add_button("previous"), gui.add_button("next")
        self._speed = gui.add_slider("speed", min=SPEEDS[0], max=SPEEDS[1], step=0.25, initial_value=speed)
        self._slider.on_update(self._scrub)
        self._episode.on_update(self._jump)
        self._play.on_click(lambda _: self._toggle())
        previous.on_click(lambda _: self.want(self._number - 1))
        following.on_click(lambda _: self.want(self._number + 1))

    def _scrub(self, event: viser.GuiEvent[Any]) -> None:
        if by_hand(event):
            self.want(int(number(self._slider, 0, self.trace.moments - 1)))

    def _jump(self, event: viser.GuiEvent[Any]) -> None:
        if by_hand(event):
            self.want(self.trace.start_of(int(number(self._episode, 0, self.trace.episodes - 1))))

    def _toggle(self) -> None:
        self._playing = not self._playing
        self._play.label = "pause" if self._playing else "play"

    def _go_to(self, number: int) -> None:
        """Show a moment as it was: at its start, or with the arm that has just put the block down."""
        self._number = number
        moment = self.trace.moment(number)
        steps = self.trace.steps[moment.first : moment.first + moment.transfers]
        with self.server.atomic():
            self.scene.show_goal(steps[max(moment.done - 1, 0)].goal)
            self.scene.show_plan([step.next_state for step in steps], [step.arm for step in steps], steps[0].state)
            if moment.done == 0:
                self.scene.show_block(steps[0].state)
                self._park()
            else:
                self._show_placed(steps[moment.done - 1])
            self._tell(moment, steps)

    def _show_placed(self, step: Step) -> None:
        self.scene.show_block(step.next_state)
        open_hands = [arm != step.arm for arm in range(self.scene.model.cell.num_arms)]
        self.scene.show_joints(self.motions.placed(step), open_hands)

    def _park(self) -> None:
        arms = self.scene.model.cell.num_arms
        self.scene.show_joints(self.motions.planner.homes_rad, [True] * arms)

    def _play_on(self, dt_s: float) -> None:
        """The next piece of the motion from this moment to the next."""
        moment = self.trace.moment(self._number)
        if moment.done == moment.transfers:
            self._rest(dt_s)
            return
        number = moment.first + moment.done
        if self._moving is None:
            self._moving, self._time_s = self.motions.ask(number, self.trace.steps[number]), 0.0
            if number + 1 < len(self.trace.steps):
                self.motions.ask(number + 1, self.trace.steps[number + 1])
        if not self._moving.done():
            return
        motion = self._moving.result()
        self._time_s += dt_s
        with self.server.atomic():
            sample = motion.at(self._time_s)
            self.scene.show_joints(motion.joints_rad[sample], motion.grip_open[sample].tolist())
            self.scene.show_block(motion.T_world_block[sample])
        if self._time_s >= motion.duration_s:
            self._moving = None
            self._advance()

    def _rest(self, dt_s: float) -> None:
        """At the end of an episode; at the end of the trace it stops playing."""
        if self._number == self.trace.moments - 1:
            self._toggle()
            return
        self._time_s += dt_s
        if self._time_s >= PAUSE_S:
            self._time_s = 0.0
            self._go_to(self._number + 1)

    def _advance(self) -> None:
        """A transfer has been played to its end: the moment is the next one, and everything stands as it is."""
        self._number, self._time_s = self._number + 1, 0.0
        moment = self.trace.moment(self._number)
        with self.server.atomic():
            self._tell(moment, self.trace.steps[moment.first : moment.first + moment.transfers])

    def _tell(self, moment: Moment, steps: list[Step]) -> None:
        self._text.content = moment_words(self.rules, self.trace, moment, steps)
        if self._slider.value != self._number:
            write(self._slider, self._number)
        if self._episode.value != moment.episode:
            write(self._episode, moment.episode)


def moment_words(rules: Rules, trace: Trace, moment: Moment, steps: list[Step]) -> str:
    """What is seen at a moment: the transfer that has just been made, and how far the block is from its goal."""
    lines = [f"**Episode {trace.names[moment.episode]}** ({trace.episodes} in all), transfer **{moment.done} of {moment.transfers}**"]
    if moment.done == 0:
        lines.append("start")
        lines.append(f"from the goal: {error_words(rules, steps[0].state, steps[0].goal)}")
        return "\n\n".join(lines)
    step = steps[moment.done - 1]
    where = "to the goal" if step.final else f"to a hand-over at {place_words(step.place_mm)}"
    lines.append(f"{plain(arm_words(rules.cell.labels[step.arm]))} {where}" + (f": {plain(step.trouble)}" if step.trouble else ""))
    lines.append(f"from the goal: {error_words(rules, step.next_state, step.goal)} ({degrees_words(step.epsilon_rad)} allowed)")
    if step.outcome:
        lines.append(STUCK if step.nobody else RESULTS[step.outcome])
    return "\n\n".join(lines)
