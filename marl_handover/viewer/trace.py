"""The page of a trace: scrub through it, or play it."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from typing import Any

import numpy as np
import viser

from marl_handover.cell import CellModel
from marl_handover.config import MotionConfig, TaskConfig
from marl_handover.task.rules import Rules
from marl_handover.viewer.inputs import by_hand, number, write
from marl_handover.viewer.scene import CellScene
from marl_handover.viewer.trace_file import Moment, Step, Trace
from marl_handover.viewer.trace_motion import Motion, Motions
from marl_handover.viewer.words import arm_name, degrees_words, error_words, place_words, plain

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
        self.scene.show_joints(np.tile(self.motions.planner.home_rad, (arms, 1)), [True] * arms)

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
    lines.append(f"{arm_name(step.arm)} {where}" + (f": {plain(step.trouble)}" if step.trouble else ""))
    lines.append(f"from the goal: {error_words(rules, step.next_state, step.goal)} ({degrees_words(step.epsilon_rad)} allowed)")
    if step.outcome:
        lines.append(STUCK if step.nobody else RESULTS[step.outcome])
    return "\n\n".join(lines)
