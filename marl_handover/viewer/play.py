"""The page to play with: drag the goal or the block, and the arms follow."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from marl_handover.arrays import Floats
from marl_handover.config import require_choice
from marl_handover.control.interactive.cell import InteractiveCell, Snapshot
from marl_handover.errors import HandoverError
from marl_handover.policies import SupervisorPolicy
from marl_handover.viewer.handles import PlaneHandle, within_reach
from marl_handover.viewer.layout_panel import LayoutPanel
from marl_handover.viewer.scene import CellScene
from marl_handover.viewer.words import at_once, by_hand, decision_words, number, plain, score_words, state_words, write

RATE_HZ = 50.0
SPEEDS = (0.25, 4.0)
NEXT_AFTER_S = 2.0
"""A solved problem is looked at for so long before the next one."""

INTRO = (
    "**Drag the ghost or the block**, or pull their arrows and arc. The arms bring the block to the ghost, turned as its arrow shows. "
    "No hand can turn the block, so it changes hands in the yellow space until the turn is right."
)
_HELD = ("grasp", "lift", "transfer", "lower", "release")
_LYING_MM = 0.5


class PlayPage:
    """Shows an :class:`InteractiveCell` and passes on what people do with it; ``dragged`` is set when that should not wait.

    Args:
        server: of the page.
        cell: what plays.
        policy: the supervisor it plays with.
        load: a policy by name; may raise any :class:`HandoverError`.
        names: of the policies to choose from, the one that plays first.
        speed: simulated seconds in one second.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        cell: InteractiveCell,
        policy: SupervisorPolicy,
        load: Callable[[str], SupervisorPolicy],
        names: Sequence[str],
        speed: float = 1.0,
    ) -> None:
        self.server, self.cell, self._policy, self._load, self._names = server, cell, policy, load, tuple(names)
        self._chosen = self._names[0]
        self.scene = CellScene(server, cell.model)
        self.dragged = threading.Event()
        self._goal_handle = PlaneHandle(server, "/goal_handle", 8.0, ["/goal/body"], self.dragged)
        self._block_handle = PlaneHandle(server, "/block_handle", 8.0, ["/block/body"], self.dragged)
        self._said: dict[str, str] = {}
        self._stopped, self._stops = False, cell.stops
        self._over_s, self._trouble, self._decision = 0.0, "", ""
        self._wanted, self._loading = "", threading.Lock()
        self._reached: tuple[Any, bytes, bool] = (None, b"", True)
        self._add_controls(speed)
        self._layout = LayoutPanel(server, cell, self.scene, self.dragged)

    def update(self, dt_s: float) -> None:
        """Let ``dt_s`` seconds of wall time pass, and show how things are."""
        obeyed = self._obey()
        snapshot = self.cell.advance(dt_s * number(self._speed, *SPEEDS))
        self._stopped = snapshot.state == "stopped"
        self._go_on(snapshot, dt_s)
        with self.server.atomic():
            self._show(snapshot)
            self._tell(snapshot)
        if obeyed:
            self.server.flush()  # what somebody waits for does not wait for other messages

    def _add_controls(self, speed: float) -> None:
        gui = self.server.gui
        gui.add_markdown(INTRO)
        self._state = gui.add_markdown("")
        stop = gui.add_button("STOP", color="red", hint="nothing moves until the stop is cleared")
        self._clear = gui.add_button("clear the stop", disabled=True)
        self._pause = gui.add_button("pause")
        new = gui.add_button("new problem")
        self._auto = gui.add_checkbox("next problem by itself", True)
        self._policy_choice = gui.add_dropdown("policy", self._names, initial_value=self._names[0])
        self._speed = gui.add_slider("speed", min=SPEEDS[0], max=SPEEDS[1], step=0.25, initial_value=speed)
        with gui.add_folder("goal in numbers", expand_by_default=False):
            self._numbers = gui.add_vector3("x, y [mm], turn [°]", (0.0, 0.0, 0.0), step=1.0)
        self._score = gui.add_markdown("")
        self._last = gui.add_markdown("")
        stop.on_click(at_once(self.cell.stop))
        self._clear.on_click(at_once(self.cell.clear))
        self._pause.on_click(at_once(self.cell.toggle))
        new.on_click(lambda _: self._renew())
        self._policy_choice.on_update(self._choose)
        self._numbers.on_update(self._enter)

    def _renew(self) -> None:
        self._done(self.cell.new_problem())

    def _choose(self, event: viser.GuiEvent[Any]) -> None:
        """Another policy, from a thread of the server's. One thread loads; what is chosen meanwhile waits, the newest only."""
        if not by_hand(event):
            return
        self._wanted = str(self._policy_choice.value)
        while self._wanted and self._loading.acquire(blocking=False):
            try:
                self._take_policy()
            finally:
                self._loading.release()

    def _take_policy(self) -> None:
        """Load the policy that is wanted, and play with it."""
        name, self._wanted = self._wanted, ""
        if not name:
            return
        stops = self.cell.stops
        try:
            require_choice("policy", name, self._names)
            policy = self._load(name)
            taken = self.cell.stops == stops and self.cell.set_policy(policy)
        except HandoverError as error:
            self._trouble, taken = str(error), False
        if taken:
            self._policy, self._chosen = policy, name
        else:
            write(self._policy_choice, self._chosen)
        self._done(taken)

    def _enter(self, event: viser.GuiEvent[Any]) -> None:
        """A goal in numbers."""
        if not by_hand(event):  # it was this page that wrote them
            return
        x_mm, y_mm, turn_deg = self._numbers.value
        pose = np.array([x_mm, y_mm, math.radians(turn_deg)])
        if np.isfinite(pose).all() and self._done(self.cell.set_goal(within_reach(self.cell.in_order, pose))):
            write(self._auto, False)
        else:
            self._said.pop("goal", None)  # the goal as it is takes the place of what was entered

    def _done(self, taken: bool) -> bool:
        """Whether something was taken up; if so, what went wrong before is of no more interest."""
        if taken:
            self._trouble = ""
        return taken

    def _obey(self) -> bool:
        """Take up what was dragged since the last time, if anything was. After a stop nothing is, lest it be done when that is cleared."""
        obeyed, stops = False, self.cell.stops
        lost = self._stopped or stops != self._stops
        for handle, move in ((self._goal_handle, self.cell.set_goal), (self._block_handle, self.cell.set_block)):
            dragged = handle.fetch()
            if dragged is None or lost:
                continue
            if self._done(move(within_reach(self.cell.in_order, dragged.pose))):
                obeyed = True
                write(self._auto, False)
        trouble = self._layout.obey(lost)
        if trouble is not None:
            obeyed, self._trouble = True, trouble
        self._stops = stops
        return obeyed

    def _go_on(self, snapshot: Snapshot, dt_s: float) -> None:
        """The next problem, some time after the last one is over."""
        over = snapshot.state in ("done", "stuck") and bool(self._auto.value)
        self._over_s = self._over_s + dt_s if over else 0.0
        if self._over_s > NEXT_AFTER_S:
            self._over_s = 0.0
            self.cell.new_problem()

    def _show(self, snapshot: Snapshot) -> None:
        self._layout.show(snapshot)
        self.scene.show_joints(snapshot.joints_rad, snapshot.grip_open)
        self.scene.show_block(snapshot.T_world_block)
        held = self._goal_handle.held
        if held is None:
            self.scene.show_goal(snapshot.goal, self._within(snapshot.goal))
        else:
            self.scene.show_goal(held, self._within(held))
        lies = snapshot.T_world_block[2, 3] < _LYING_MM and snapshot.phase not in _HELD
        self._goal_handle.show(None if self._stopped else snapshot.goal)
        self._block_handle.show(snapshot.block if lies and not self._stopped else None)
        plan = snapshot.plan
        self.scene.show_plan([placement.pose for placement in plan], [placement.arm for placement in plan])

    def _within(self, goal: Floats) -> bool:
        """Whether an arm reaches the goal (3,); looked at anew where it, or the cell, is another one."""
        cell, place = self.cell.in_order, goal.tobytes()
        if self._reached[0] is not cell or self._reached[1] != place:
            self._reached = cell, place, bool(cell.reaches(goal[:2]).any())
        return self._reached[2]

    def _tell(self, snapshot: Snapshot) -> None:
        """Texts and buttons, where they have changed."""
        rules, labels = self._policy.rules, self.cell.model.cell.labels
        if snapshot.plan:
            self._decision = decision_words(rules, snapshot.plan, snapshot.goal, labels)
        self._say(
            "state",
            self._state,
            f"{state_words(snapshot, labels)}\n\n{plain(snapshot.message)}\n\n{plain(self._trouble)}\n\n{plain(self._layout.note)}",
        )
        self._say("score", self._score, score_words(snapshot))
        self._say("last", self._last, f"Last decision: {self._decision}" if self._decision else "")
        label = "go on" if snapshot.state == "paused" else "pause"
        if self._said.get("pause") != label:
            self._said["pause"] = self._pause.label = label
        if self._clear.disabled == self._stopped:
            self._clear.disabled, self._pause.disabled = not self._stopped, self._stopped
        goal = tuple(round(float(value), 1) for value in (*snapshot.goal[:2], math.degrees(snapshot.goal[2])))
        if self._said.get("goal") != str(goal):
            self._said["goal"] = str(goal)
            write(self._numbers, goal)

    def _say(self, key: str, handle: viser.GuiMarkdownHandle, text: str) -> None:
        if self._said.get(key) != text:
            self._said[key] = handle.content = text
