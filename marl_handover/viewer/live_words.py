"""What the live page says, as HTML. Everything that comes from a session is text and nothing else: it is escaped here."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.hardware.settings import ARMS
from marl_handover.palette import ALERT, BLUE, GREY, INK, PAPER, YELLOW
from marl_handover.runtime.events import FAULTS
from marl_handover.runtime.feed import Reading
from marl_handover.viewer.words import DOING
from marl_handover.wording import counted

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
    rows = [
        (f"{number}", f"{ARMS[step['arm']]} arm", "to the goal" if step["final"] else "hand-over", _pose(step["pose"]))
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
