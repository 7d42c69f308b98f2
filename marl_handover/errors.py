"""Named errors that carry the value, the limit and the valid choices.

Every error a user can cause derives from :class:`HandoverError`; the command line prints its message as one line and exits
with ``exit_status``.
"""

from __future__ import annotations

import errno
import operator
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

PACKAGE = "marl_handover"
CORE = ""
"""The name under which :func:`requirements` has what is needed without any extra."""


def requirements() -> dict[str, tuple[str, ...]]:
    """Requirements such as ``"viser>=1.1"`` of the core and of each extra on this Python; empty if nothing tells.

    They are those of the checkout's pyproject.toml or of the installed package's metadata. An editable install's metadata is as old as the
    install, so the checkout goes first.
    """
    import tomllib  # here: a stop needs errors, and must wait for nothing else
    from importlib.metadata import PackageNotFoundError, requires

    file = Path(__file__).resolve().parents[1] / "pyproject.toml"
    if file.is_file():
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        groups = {CORE: project["dependencies"], **project["optional-dependencies"]}
        return {extra: tuple(map(_unconditional, filter(applies, lines))) for extra, lines in groups.items()}
    try:
        return by_extra(requires(PACKAGE) or [])
    except PackageNotFoundError:
        return {}


def by_extra(lines: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Requirements of the core and of each extra on this Python, from the lines of a package's metadata."""
    found: dict[str, list[str]] = {}
    for line in filter(applies, lines):
        extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)", line)
        found.setdefault(extra[1] if extra else CORE, []).append(_unconditional(line))
    return {extra: tuple(needed) for extra, needed in found.items()}


def applies(requirement: str, python: tuple[int, int] = sys.version_info[:2]) -> bool:
    """Whether what a requirement says of Python's version, such as ``python_version < '3.12'``, holds; true if it says nothing."""
    said = re.findall(r"python_version\s*(<=?|>=?)\s*['\"](\d+)\.(\d+)['\"]", requirement)
    return all(_COMPARED[sign](python, (int(major), int(minor))) for sign, major, minor in said)


_COMPARED = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def _unconditional(requirement: str) -> str:
    return requirement.partition(";")[0].strip()


def name_of(requirement: str) -> str:
    """The package of a requirement, without versions, extras and conditions."""
    return re.split(r"[^\w.-]", requirement.strip(), maxsplit=1)[0]


def install_line(extra: str = CORE, only: Iterable[str] = ()) -> str:
    """The command that installs what an extra needs, or, of that, the packages named in ``only``."""
    wanted = {name.lower() for name in only}
    needed = [line for line in requirements().get(extra, ()) if not wanted or name_of(line).lower() in wanted] or list(only)
    return "pip install " + " ".join(f"'{line}'" if re.search(r"[<>=!~\[; ]", line) else line for line in needed)


LONGEST_VALUE, LONGEST_LIST, LONGEST_REASON = 120, 160, 220
"""Characters of a value, of a list of choices and of a reason in a message."""


def shortened(text: str, longest: int = LONGEST_VALUE, keep_end: bool = True) -> str:
    """``text``, its middle left out if it is longer than ``longest``: both ends of a value tell most. Of a sentence the beginning does."""
    if len(text) <= longest:
        return text
    if not keep_end:
        return f"{text[: longest - 4]} ..."
    head = (longest - 5) * 2 // 3
    return f"{text[:head]} ... {text[len(text) - (longest - 5 - head) :]}"


def shown(value: Any, longest: int = LONGEST_VALUE) -> str:
    """A value as messages show it: its short ``repr``."""
    try:
        return shortened(repr(value), longest)
    except ValueError:  # the interpreter writes out no number of more than 4300 digits
        return "a number of thousands of digits"


def listed(choices: Iterable[Any], longest: int = LONGEST_LIST) -> str:
    """Choices, separated by commas, as many as there is room for; the first ones matter most."""
    names, length = [str(choice) for choice in choices], 0
    for index, name in enumerate(names):
        length += len(name) + 2
        if length > longest and index:
            return f"{', '.join(names[:index])} and {len(names) - index} more"
    return ", ".join(names)


class HandoverError(Exception):
    """Base of all errors of this package. Attribute ``exit_status``: 2 for bad input, 1 for work that failed."""

    exit_status = 2

    def __reduce__(self) -> Any:
        """What workers raise says the same here: an error is made anew of its message, not of what its constructor takes."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[HandoverError], arguments: tuple[Any, ...], attributes: dict[str, Any]) -> HandoverError:
    error = kind.__new__(kind, *arguments)
    error.__dict__.update(attributes)
    return error


class WorkFailed(HandoverError):
    """The input was fine, but the work could not be done."""

    exit_status = 1


class InvalidSetting(HandoverError):
    """A setting has a value outside its limits."""

    def __init__(self, name: str, value: Any, limit: str) -> None:
        super().__init__(f"{shortened(name, LONGEST_LIST)} = {shown(value)}: must be {limit}")
        self.name, self.value, self.limit = name, value, limit


class GoalInObservation(InvalidSetting):
    """A goal environment was to show a layout that depends on the goal, of which a hindsight buffer would keep the old one."""

    def __init__(self, layout: str, instead: str) -> None:
        limit = f"{instead!r} here: others contain the goal, which hindsight replaces in desired_goal only; env.features() computes them"
        super().__init__("layout", layout, limit)


class UnknownChoice(HandoverError):
    """A name is none of the valid choices."""

    def __init__(self, name: str, value: Any, choices: Iterable[str]) -> None:
        self.name, self.value, self.choices = name, value, tuple(choices)
        super().__init__(f"{shortened(name)} = {shown(value)} is not known; choose one of: {listed(self.choices)}")


class NoWindow(UnknownChoice):
    """A window was asked for where there is none to be had."""

    def __init__(self, value: str, choices: Iterable[Any], why: str) -> None:
        super().__init__("render_mode", value, choices)
        self.args = (f"render_mode = {value!r} needs a window: {why}; choose one of: {listed(self.choices)}",)
        self.why = why


class UnknownKey(HandoverError):
    """A configuration key that does not exist."""

    def __init__(self, key: str, choices: Iterable[str]) -> None:
        self.key, self.choices = key, tuple(choices)
        super().__init__(f"unknown key {shown(key, LONGEST_LIST)}; valid keys: {listed(self.choices)}")


class RenamedKey(HandoverError):
    """A key, or a name, that is called otherwise now."""

    def __init__(self, old: str, new: str) -> None:
        super().__init__(f"{shown(old, LONGEST_LIST)} is called {shown(new, LONGEST_LIST)} now")
        self.old, self.new = old, new


class BadOverride(HandoverError):
    """A ``key=value`` argument that cannot be read."""

    def __init__(self, text: str, reason: str) -> None:
        super().__init__(f"cannot read {shown(text)}: {shortened(reason, LONGEST_REASON, keep_end=False)}")
        self.text, self.reason = text, reason


class MissingFile(HandoverError):
    """A file or folder that was named is not there."""

    def __init__(self, what: str, path: Path | str, fix: str = "check the path") -> None:
        super().__init__(f"{what} not found: {shortened(str(path), LONGEST_LIST)}; {fix}")
        self.what, self.path, self.fix = what, Path(path), fix


class CorruptFile(HandoverError):
    """A file is there but cannot be read as what it should be."""

    def __init__(self, what: str, path: Path | str, reason: str) -> None:
        super().__init__(f"{what} {shortened(str(path), LONGEST_LIST)} cannot be read: {shortened(reason, LONGEST_REASON, keep_end=False)}")
        self.what, self.path, self.reason = what, Path(path), reason


class ChecksumMismatch(HandoverError):
    """A file whose content is part of what a result means is another one than it should be. ``found``, ``wanted``: its SHA-256."""

    def __init__(self, path: Path | str, found: str, wanted: str) -> None:
        super().__init__(
            f"{shortened(str(path), LONGEST_LIST)} was changed: its SHA-256 is {found[:12]}…, not {wanted[:12]}…; install the package again"
        )
        self.path, self.found, self.wanted = Path(path), found, wanted


class BadLine(HandoverError):
    """A line of a file says what cannot be; ``error`` says why."""

    def __init__(self, what: str, path: Path | str, number: int, error: HandoverError) -> None:
        super().__init__(f"line {number} of {what} {shortened(str(path), LONGEST_REASON // 3)}: {error}")
        self.what, self.path, self.number, self.error = what, Path(path), number, error


class CannotWrite(HandoverError, OSError):
    """A file cannot be written. ``exit_status`` is 1 if its path is fine but there is no room, 2 if nothing can be written there."""

    def __init__(self, path: Path | str, error: OSError) -> None:
        super().__init__(error.errno, error.strerror or str(error))
        self.path, self.exit_status = Path(path), exit_status_of(error)

    def __str__(self) -> str:
        return f"{self.path} cannot be written: {self.strerror}"


def exit_status_of(error: OSError) -> int:
    """1 for a device that is full or fails, 2 for a path that cannot be."""
    return 1 if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO) else 2


class UrdfError(HandoverError):
    """A URDF lacks a link or joint that the cell needs, or is malformed."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"URDF {path}: {problem}")
        self.path, self.problem = Path(path), problem


class UnsupportedKinematics(UrdfError):
    """The arm is not of the class yaw + planar 3R + roll, for which the inverse kinematics are closed-form."""


class NoSharedSpace(HandoverError):
    """The two annuli do not overlap in one connected piece."""

    def __init__(self, base_distance_mm: float, r_min_mm: float, r_max_mm: float, reason: str = "") -> None:
        self.base_distance_mm, self.r_min_mm, self.r_max_mm = base_distance_mm, r_min_mm, r_max_mm
        because = reason or (
            f"half of it must lie between r_min = {r_min_mm:g} mm and r_max = {r_max_mm:g} mm; "
            f"choose base_distance_mm between {2 * r_min_mm:g} and {2 * r_max_mm:g}"
        )
        super().__init__(f"no connected shared space at base_distance_mm = {base_distance_mm:g}: {because}")


class TwoArmsOnly(HandoverError):
    """Something that is made for two arms was asked of a cell with another number of them."""

    def __init__(self, what: str, names: Sequence[str], instead: str = "") -> None:
        self.what, self.names, self.instead = what, tuple(names), instead
        there = f"this cell has {len(self.names)}: {listed(self.names)}"
        super().__init__(f"{what} is for two arms; {there}{'; ' if instead else ''}{instead}")


class UnequalArms(HandoverError):
    """Something that is made for arms of one kind was asked of a cell whose arms differ."""

    def __init__(self, what: str, values: Mapping[str, Any]) -> None:
        self.what, self.values = what, dict(values)
        listed = ", ".join(f"{name} {value}" for name, value in self.values.items())
        super().__init__(f"all arms must have the same {what} for this; they have: {listed}")


class UnconnectedArms(HandoverError):
    """Some arms of a cell cannot pass an object to the others, however long the way."""

    def __init__(self, groups: Sequence[Sequence[str]], obstacles: bool = False) -> None:
        self.groups = [list(group) for group in groups]
        listed = " and ".join(f"({', '.join(group)})" for group in self.groups)
        fix = "turn them, or move the obstacles" if obstacles else "or turn them"
        super().__init__(f"the arms fall into groups that share no place: {listed}; stand them nearer to each other, {fix}")


class BlockedPlace(HandoverError):
    """A position where an obstacle keeps anything from being put. ``disc``: its x, y and radius, half the block's diagonal included."""

    def __init__(self, what: str, position_mm: tuple[float, float], disc: tuple[float, float, float]) -> None:
        self.what, self.position_mm, self.disc = what, position_mm, disc
        super().__init__(
            f"{what} ({position_mm[0]:g}, {position_mm[1]:g}) mm is inside an obstacle; it must be at least {disc[2]:.1f} mm "
            f"from ({disc[0]:g}, {disc[1]:g}) mm, half the block's diagonal included"
        )


class OutOfReach(HandoverError):
    """A position that no arm can reach. ``rings_mm``: least and greatest radius of each arm, by its name."""

    def __init__(self, what: str, position_mm: tuple[float, float], rings_mm: Mapping[str, tuple[float, float]]) -> None:
        self.what, self.position_mm, self.rings_mm = what, position_mm, dict(rings_mm)
        alike = len(set(self.rings_mm.values())) == 1
        ring = next(iter(self.rings_mm.values()))
        rings = {"a base": ring} if alike else {f"the base of {name!r}": ring for name, ring in rings_mm.items()}
        allowed = " or ".join(f"{low:g} to {high:g} mm from {base}" for base, (low, high) in rings.items())
        super().__init__(
            f"{what} ({position_mm[0]:g}, {position_mm[1]:g}) mm is out of every arm's reach; "
            f"it must lie {allowed}, within the arm's yaw range"
        )


class NotFinite(InvalidSetting):
    """A number that must be finite is NaN or infinite."""

    def __init__(self, what: str, value: Any) -> None:
        HandoverError.__init__(self, f"{what} = {shortened(str(value))}: every number must be finite")
        self.what = self.name = what
        self.value, self.limit = value, "finite"


class Diverged(WorkFailed):
    """A training whose losses are no numbers any more: what it would learn from here on is nothing."""

    def __init__(self, step: int, losses: dict[str, float]) -> None:
        found = ", ".join(f"{name} = {value}" for name, value in losses.items())
        super().__init__(f"training diverged before step {step}: {found}; try a smaller algorithm.learning_rate or another seed")
        self.step, self.losses = step, losses


class CheckpointMismatch(HandoverError):
    """A checkpoint was made for other settings than the ones asked for."""

    def __init__(self, path: Path | str, key: str, stored: Any, wanted: Any) -> None:
        super().__init__(f"checkpoint {path} has {key} = {stored!r}, but {wanted!r} was asked for")
        self.path, self.key, self.stored, self.wanted = Path(path), key, stored, wanted


class MissingExtra(HandoverError):
    """A setting needs a package that is not installed."""

    def __init__(self, setting: str, package: str, extra: str) -> None:
        super().__init__(f"{setting} needs the package {package}; run: {install_line(extra)}")
        self.setting, self.package, self.extra = setting, package, extra


class MissingProgram(WorkFailed):
    """Something needs a program that is not on this machine."""

    def __init__(self, what: str, program: str, fix: str) -> None:
        super().__init__(f"{what} needs the program {program}, which is not here; {fix}")
        self.what, self.program, self.fix = what, program, fix


def first_line(error: BaseException) -> str:
    """First line of what an error says, or its kind if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def counted(count: int, what: str) -> str:
    """``1 transfer``, ``2 transfers``."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"
