"""The page on which a session with real arms, or the twin's, is watched and, if it allows that, steered.

The session is another process. All that joins them is the folder it publishes in, so that nothing that happens here reaches it but what
a :class:`~marl_handover.control.telemetry_reader.TelemetryReader` asks for.
"""

from __future__ import annotations

import html
import math
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import viser

from marl_handover.arrays import Floats
from marl_handover.cell import CellModel, build_cell
from marl_handover.cell.cell import Cell
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.compose import from_mapping
from marl_handover.config import CellConfig
from marl_handover.control.events import FAULTS
from marl_handover.control.interactive.world_state import lying, projected
from marl_handover.control.remote_control import MAX_AGE_S, SessionCommand
from marl_handover.control.telemetry_reader import Reading, TelemetryReader
from marl_handover.errors import HandoverError, counted
from marl_handover.geometry.se3 import flat_pose, transform
from marl_handover.palette import ALERT, BLUE, GREY, INK, PAPER, YELLOW
from marl_handover.viewer.scene import CellScene
from marl_handover.viewer.words import DOING, at_once

RESTING = {"armed": "holds"}
"""What an arm does that does not move, by the driver's state; else that itself."""

QUIET_S = 20.0
"""A session that says nothing of itself for longer than this, though it is not paused, may hang."""

BIG_RED = '<style>button[style*="color-red-filled"]{height:3.6rem !important;font-size:1.4rem !important;font-weight:700}</style>'
"""Makes the one red button one that is found in a hurry; viser has one size."""

_SMALL = "font-size:0.8rem;line-height:1.35;padding:0 0.75rem 0.35rem"
_CELL = "padding:0.05rem 0.6rem 0.05rem 0;text-align:left;vertical-align:top"
_LOG = "font-size:0.68rem;line-height:1.3;max-height:15rem;overflow:auto;white-space:pre-wrap;margin:0;padding:0.3rem 0.75rem"
_NUMBERS = ("pose", "goal", "was", "place", "next_state")


def headline(reading: Reading) -> str:
    """What the session is doing, or why nobody knows."""
    state = reading.state
    if state is None:
        return _banner("no session", reading.problem, GREY)
    word, text = state["doing"], state["text"]
    if reading.problem:
        return _banner("NO NEWS" if not reading.live else word, reading.problem, ALERT)
    if word in ("stopped", "failed"):
        return _banner(word.upper(), _broken_off(state), ALERT)
    if state.get("latch", {}).get("set") and not state["over"]:
        return _banner("STOP IS LATCHED", state["latch"]["reason"], ALERT)
    if state["over"]:
        return _banner("session ended", text, GREY)
    if word == "moving":
        word = _motion(state)
    if word != "paused" and state.get("pausing"):
        return _banner(word, "pauses before the next transfer", YELLOW)
    if word == "paused":
        return _banner("paused", "no transfer begins before somebody goes on", YELLOW)
    if state["quiet_s"] > QUIET_S:
        text = f"the session has said nothing for {state['quiet_s']:.0f} s. {text}"
    return _banner(word, text, ALERT if word.startswith("waiting") else BLUE)


def facts(state: Mapping[str, Any]) -> str:
    """What runs, how far it is, what went wrong so far."""
    totals, episode, faults = state.get("totals"), state.get("episode"), state.get("faults") or {}
    rows = [("session", f"{state.get('hardware', '?')}, policy {state.get('policy', '?')}{', dry run' if state.get('dry_run') else ''}")]
    if totals and episode:
        rows.append(("episode", _progress(episode, ended=bool(state["over"]) or totals["episodes"] > episode["number"])))
        rows.append(("solved", f"{totals['solved']} of {totals['episodes']}; {counted(totals['transfers'], 'transfer')}"))
    block = state.get("block") or {}
    if block.get("pose"):
        sure = "" if block["confidence"] is None else f", confidence {block['confidence']:.2f}"
        rows.append(("block", f"{_pose(block['pose'])}{sure}{'' if block['seen'] else ', not in this picture'}"))
    if state.get("goal"):
        rows.append(("goal", _pose(state["goal"])))
    if faults:
        rows.append(("trouble", ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in faults.items())))
    if state["failures"]["count"]:
        rows.append(("not published", f"{counted(state['failures']['count'], 'time')}: {state['failures']['last']}"))
    return _table(rows)


def arms(state: Mapping[str, Any]) -> str:
    """What each arm does, and where its joints are wanted."""
    rows: list[Sequence[str]] = [("<b>arm</b>", "<b>does</b>", "<b>fingers</b>", "<b>joints wanted [°]</b>")]
    for arm in state.get("arms", ()):
        doing = DOING.get(state["phase"], "moves") if arm["moving"] else RESTING.get(state["driver"], state["driver"])
        doing = "does not move the block" if arm["stalled"] else doing
        fingers = "?" if arm["gripper_mm"] is None else f"{arm['gripper_mm']:.1f} mm"
        joints = "not known" if arm["joints_rad"] is None else " ".join(f"{round(math.degrees(value))}" for value in arm["joints_rad"])
        rows.append([html.escape(text) for text in (arm["name"], doing, fingers, joints)])
    return _table(rows, escaped=True)


def plan(state: Mapping[str, Any]) -> str:
    """The hand-overs to come."""
    steps = state.get("plan") or []
    if not steps:
        return f'<div style="{_SMALL}">nothing planned</div>'
    names = [arm["name"] for arm in state["arms"]]
    rows = [
        (f"{number}", f"{names[step['arm']]} arm", "to the goal" if step["final"] else "hand-over", _pose(step["pose"]))
        for number, step in enumerate(steps, 1)
    ]
    return _table(rows)


def log(rows: Iterable[Mapping[str, Any]]) -> str:
    """Events, a line each, the newest first."""
    return f'<pre style="{_LOG}">' + "\n".join(_event(row) for row in reversed(list(rows))) + "</pre>"


def note(text: str) -> str:
    """A plain line."""
    return f'<div style="{_SMALL}">{html.escape(text)}</div>' if text else ""


def _broken_off(state: Mapping[str, Any]) -> str:
    """Why, and what that means for the arms and for whoever wants them to move again."""
    latched = bool(state.get("latch", {}).get("set"))
    told = (
        state["text"],
        "Arms hold" if state.get("armed") else "",
        "To allow motion, at the cell: marl-handover stop clear=true" if latched else "",
    )
    return ". ".join(part for part in told if part)


def _progress(episode: Mapping[str, Any], ended: bool) -> str:
    """Which episode it is, from 1, and how far it is or went."""
    if episode["number"] < 0:
        return "none yet"
    transfers = episode["transfers"]
    return f"{episode['number'] + 1}, {f'ended; transfers: {transfers}' if ended else f'transfer {transfers + 1}'}"


def _motion(state: Mapping[str, Any]) -> str:
    moving = next((arm for arm in state.get("arms", ()) if arm["moving"]), None)
    return "an arm is about to move" if moving is None else f"{moving['name']} arm {DOING.get(state['phase'], 'moves')}"


def _event(row: Mapping[str, Any]) -> str:
    name = str(row["event"])
    parts = [f"{key} {_value(key, value)}" for key, value in row.items() if key in _SHOWN.get(name, _ALWAYS) and value is not None]
    when = row.get("t_s")
    line = html.escape(f"{when:8.2f}  " if _finite(when) else " " * 10) + html.escape(f"{name}  {', '.join(parts)}")
    return f'<b style="color:{ALERT}">{line}</b>' if name in FAULTS else line


_ALWAYS = ("arm", "pose", "goal", "was", "place", "text", "reason", "what", "after_s", "command", "refused", "ended", "transfers", "seed")
_SHOWN = {"motion": ("arm",), "transfer": ("arm", "final", "next_state", "refusal", "outcome"), "session": ("policy", "hardware")}


def _value(key: str, value: Any) -> str:
    if key in _NUMBERS and isinstance(value, list) and len(value) in (2, 3) and all(_finite(item) for item in value):
        return _pose(value)
    if key == "arm" and type(value) is int and value in (0, 1):
        return ARM_LETTERS[value]
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _pose(pose: Sequence[float]) -> str:
    place = f"({round(pose[0])}, {round(pose[1])}) mm"
    return f"{place} {round(math.degrees(pose[2]))}°" if len(pose) == 3 else place


def _banner(word: str, text: str, colour: str) -> str:
    ink = INK if colour == YELLOW else PAPER
    style = f"background:{colour};color:{ink};margin:0 0.75rem 0.5rem;padding:0.45rem 0.7rem;border-radius:4px"
    rest = f'<div style="font-size:0.78rem">{html.escape(text)}</div>' if text else ""
    return f'<div style="{style}"><b>{html.escape(word)}</b>{rest}</div>'


def _table(rows: Iterable[Sequence[str]], escaped: bool = False) -> str:
    lines = ("".join(f'<td style="{_CELL}">{cell if escaped else html.escape(cell)}</td>' for cell in row) for row in rows)
    return f'<div style="{_SMALL}"><table style="border-collapse:collapse">{"".join(f"<tr>{line}</tr>" for line in lines)}</table></div>'


LOG_LINES = 30
STOP_REASON = "STOP pressed in the browser"
ANSWER_S = 1.0
"""A session that has not obeyed a stop by then does not run, or hangs."""

FRESH_S = 1.0
"""A picture that is older than this says so."""

_EMPTY_PX = (360, 640, 3)
_OPEN_MM = 4.0
_PUT_DOWN = ("release", "retreat")


class LivePage:
    """Shows what a folder tells of a session.

    Args:
        server: of the page.
        scene: of the session's cell, as far as that is known. None, or of another cell: it is built when the session says what it is.
        feed: of the folder.
    """

    def __init__(self, server: viser.ViserServer, scene: CellScene | None, feed: TelemetryReader) -> None:
        self.server, self.scene, self.feed = server, scene, feed
        self._said: dict[str, str] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=LOG_LINES)
        self._heard = self._session = self._trouble = ""
        self._stopping: tuple[float, str] | None = None
        self._asked: tuple[int, str, float] | None = None
        self._held: Floats | None = None
        self._asking = threading.Lock()
        self._add_controls()

    def update(self, dt_s: float = 0.0) -> None:
        """Show the newest state; to be called at most 30 times a second, from one thread. What cannot be shown is said."""
        failed = ""
        try:
            reading = self.feed.read()
        except Exception as error:  # whatever a folder holds, the page with its STOP button has to stay
            reading = Reading(None, False, f"the folder cannot be read: {type(error).__name__}: {error}", 0.0)
        with self.server.atomic():
            for part in (self._follow, self._look, self._show_state, self._tell):
                try:
                    part(reading)
                except Exception as error:  # as above
                    failed = failed or f"the session's state cannot be shown: {type(error).__name__}: {error}"
            self._say("failure", self._failure, note(failed))

    def _follow(self, reading: Reading) -> None:
        """Another session: what was said of the one before does not hold for it."""
        state = reading.state
        if state is not None and state["session"] != self._heard:
            self._heard, self._trouble = state["session"], ""
            self._asked = self._stopping = self._held = None
            self._events.clear()
        self._events.extend(self.feed.events())
        if state is not None and state["session"] != self._session:
            self._begin(state)

    def _look(self, _: Reading) -> None:
        picture = self.feed.picture()
        if picture is not None:
            self._camera.image = picture

    def _show_state(self, reading: Reading) -> None:
        if reading.state is not None and self.scene is not None:
            self._show(self.scene, reading.state)

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.add_html(BIG_RED)
        self._headline = gui.add_html("")
        self._failure = gui.add_html("")
        stop = gui.add_button("STOP", color="red", hint="stops every servo where it is; cleared only at the cell, by hand")
        self._stop_note = gui.add_html("")
        self._start = gui.add_button("start", disabled=True)
        self._pause = gui.add_button("pause", disabled=True, hint="no new transfer begins; the one that goes on is finished")
        self._steering = gui.add_html("")
        with gui.add_folder("another goal", expand_by_default=False):
            self._goal = gui.add_vector3("x, y [mm], turn [°]", (0.0, 0.0, 0.0), step=1.0)
            self._send = gui.add_button("send goal", disabled=True)
        self._camera = gui.add_image(np.full(_EMPTY_PX, 60, np.uint8), label="camera: no picture yet")
        self._facts = gui.add_html("")
        with gui.add_folder("arms"):
            self._arms = gui.add_html("")
        with gui.add_folder("next hand-overs"):
            self._plan = gui.add_html("")
        with gui.add_folder("events, newest first"):
            self._log = gui.add_html("")
        stop.on_click(at_once(self.stop))
        self._start.on_click(lambda _: self._ask(SessionCommand.START))
        self._pause.on_click(lambda _: self._ask(SessionCommand.PAUSE))
        self._send.on_click(lambda _: self._ask(SessionCommand.GOAL))

    def stop(self) -> None:
        """Latch the stop. From any thread; it does not wait for anything on this page."""
        self._stopping = (time.monotonic(), self.feed.stop(STOP_REASON))

    def _ask(self, command: SessionCommand) -> None:
        x_mm, y_mm, turn_deg = self._goal.value
        goal = [x_mm, y_mm, math.radians(turn_deg)] if command is SessionCommand.GOAL else None
        if not self._asking.acquire(blocking=False):
            return  # somebody's request is being written; a viewer that asks without end fills no queue
        try:
            self._asked = (self.feed.ask(command, goal), str(command), time.monotonic())
            self._trouble = ""
        except HandoverError as error:
            self._trouble = str(error)
        finally:
            self._asking.release()

    def _begin(self, state: dict[str, Any]) -> None:
        """Maybe it has another cell."""
        wanted = _cell_config(state)
        if wanted is None:
            return
        self._session = state["session"]
        if self.scene is not None and self.scene.model.cell.config == wanted:
            return
        self._said.pop("joints", None)
        try:
            model = build_cell(wanted)
            self.server.scene.reset()
            self.scene = CellScene(self.server, model)
        except Exception as error:  # of whatever the state says the cell is
            self.scene = None
            self._trouble = f"the session's cell cannot be shown: {error}"

    def _show(self, scene: CellScene, state: dict[str, Any]) -> None:
        arms = state.get("arms", ())
        known = [arm["joints_rad"] for arm in arms]
        if known and all(joints is not None for joints in known):
            opened = [arm["gripper_mm"] is None or arm["gripper_mm"] > _OPEN_MM for arm in arms]
            scene.show_joints(np.array(known), opened)
        elif not self._said.get("joints") and state.get("home_rad"):
            self._said["joints"] = "parked"
            scene.show_joints(np.tile(state["home_rad"], (scene.model.cell.num_arms, 1)))
        scene.show_block(self._block(scene.model, state))
        scene.show_goal(state.get("goal"))
        steps = state.get("plan", ())
        scene.show_plan([step["pose"] for step in steps], [step["arm"] for step in steps])

    def _block(self, model: CellModel, state: dict[str, Any]) -> Floats | None:
        """T_world_block (4, 4): where it was seen; in the hand, as that took it from there; then where that put it."""
        pose = (state.get("block") or {}).get("pose")
        if pose is None:
            return None
        holder = next((index for index, arm in enumerate(state["arms"]) if arm["holding"] and arm["joints_rad"] is not None), None)
        if holder is not None:
            base = model.cell.bases[holder]
            T_world_base = base.matrix()
            now = T_world_base @ model.arms[holder].fk(np.array(state["arms"][holder]["joints_rad"], float))
            self._held = now @ np.linalg.inv(_picking(model.cell, holder, pose)) @ flat_pose(*pose)
            return self._held
        if state["phase"] in _PUT_DOWN and state["doing"] == "moving":
            if self._held is not None:
                return lying(projected(self._held))
            return flat_pose(*(state["plan"][0]["pose"] if state.get("plan") else pose))
        self._held = None
        return flat_pose(*pose)

    def _tell(self, reading: Reading) -> None:
        """Texts and buttons, where they have changed."""
        state = reading.state
        self._say("headline", self._headline, headline(reading))
        self._say("stop", self._stop_note, note(self._stop_words(reading)))
        if state is None:
            return
        steered = bool(state["view_control"]) and reading.live
        waiting = bool(state.get("pausing"))
        for handle, usable in ((self._start, steered and waiting), (self._pause, steered and not waiting), (self._send, steered)):
            if handle.disabled == usable:
                handle.disabled = not usable
        self._say("steering", self._steering, note(self._trouble or self._steering_words(reading)))
        if "episode" not in state:
            return
        label = _camera_label(reading)
        if self._camera.label != label:
            self._camera.label = label
        self._say("facts", self._facts, facts(state))
        self._say("arms", self._arms, arms(state))
        self._say("plan", self._plan, plan(state))
        self._say("log", self._log, log(self._events))

    def _stop_words(self, reading: Reading) -> str:
        """What became of a stop that was asked for here."""
        if self._stopping is None:
            return ""
        asked_s, done = self._stopping
        pid = self.feed.latch().obeyed_by()
        if pid is not None:
            return f"{done}; process {pid} has stopped its arms"
        if reading.state is not None and reading.state["over"]:
            return f"{done}; the session is over"
        return f"{done}; no session has answered: if arms move, CUT THE POWER" if time.monotonic() - asked_s > ANSWER_S else done

    def _steering_words(self, reading: Reading) -> str:
        """What became of what was asked for, here or at another page."""
        state = reading.state
        assert state is not None
        if not reading.live:
            return ""
        if not state["view_control"]:
            return "Watching only: the session was started without view_control=true. STOP works."
        answer = state.get("control")
        if self._asked is not None and (not answer or answer["number"] < self._asked[0]):
            _, command, asked_s = self._asked
            return f"{command}: asked" if time.monotonic() - asked_s < MAX_AGE_S else f"{command}: the session has not taken it"
        if answer and answer["refused"]:
            return f"{answer['command']} was refused: {answer['refused']}"
        return f"{answer['command']}: done" if answer else ""

    def _say(self, key: str, handle: viser.GuiHtmlHandle, text: str) -> None:
        if self._said.get(key) != text:
            self._said[key] = handle.content = text


def _camera_label(reading: Reading) -> str:
    state = reading.state or {}
    age_s = state.get("picture_s_ago")
    if not state.get("picture") or age_s is None:
        return "camera: no picture yet"
    if not reading.live:
        return "camera: the last picture"
    return "camera" if age_s < FRESH_S else f"camera, {age_s:.0f} s ago"


def _cell_config(state: dict[str, Any]) -> CellConfig | None:
    """The session's cell; None as long as it has not said."""
    try:
        return from_mapping(CellConfig, state["cell"], Path("session"))
    except (KeyError, AttributeError, HandoverError):
        return None


def _picking(cell: Cell, arm: int, pose: list[float]) -> Floats:
    """T_world_grip (4, 4) of an arm that takes the block at ``pose`` (3,): level, at the height where blocks are held."""
    yaw = float(cell.gripper_yaw(cell.polar(np.array(pose[:2], float))[1])[arm])
    return transform((pose[0], pose[1], cell.pick_heights_mm[arm]), (0.0, 0.0, yaw))
