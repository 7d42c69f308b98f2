"""A session of the closed loop on a cell: episodes, their goals, and the log of it all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.control.closed_loop import ClosedLoop
from marl_handover.control.events import Event, EventLog
from marl_handover.control.hardware_backend import HardwareBackend
from marl_handover.control.remote_control import CommandQueue
from marl_handover.control.transfers import Episode, Transfer, transfer_row
from marl_handover.errors import WorkFailed
from marl_handover.hardware.errors import Stopped

Goals = Callable[[], Floats]


class NoGoal(WorkFailed):
    """The printed goal was not seen."""

    def __init__(self) -> None:
        super().__init__("no goal: lay the printed goal marker where the camera sees it, or give goal=[x,y,deg]")


class GivenGoal:
    """A goal that stays until somebody sets another, from any thread."""

    def __init__(self, goal: ArrayLike) -> None:
        self._goal = np.asarray(goal, float)

    def set(self, goal: ArrayLike) -> None:
        """From the next decision on, the block is to go to ``goal`` (3,)."""
        self._goal = np.asarray(goal, float)

    def __call__(self) -> Floats:
        """The goal (3,)."""
        return self._goal.copy()


class PrintedGoal:
    """The goal is wherever the printed marker was seen last; one that is covered stays where it was, from one episode to the next too.

    Sightings within ``same_mm`` and ``same_rad`` are of a marker that has not moved.
    """

    def __init__(self, backend: HardwareBackend, same_mm: float = 3.0, same_rad: float = 0.05) -> None:
        self._backend, self._same_mm, self._same_rad = backend, same_mm, same_rad
        self._goal: Floats | None = None

    def forget(self) -> None:
        """Somebody has laid the marker elsewhere: from now on it has to be seen again."""
        self._goal = None

    def __call__(self) -> Floats:
        """The goal (3,). Raises :class:`NoGoal` if it was never seen."""
        seen = self._backend.goal()
        if seen is None and self._goal is None:
            raise NoGoal()
        if seen is not None and (self._goal is None or self._differs(seen, self._goal)):
            self._goal = seen.copy()
        assert self._goal is not None
        return self._goal.copy()

    def _differs(self, one: Floats, other: Floats) -> bool:
        turned = abs(float(np.angle(np.exp(1j * (one[2] - other[2])))))
        return float(np.hypot(*(one[:2] - other[:2]))) > self._same_mm or turned > self._same_rad


class Session:
    """Plays episodes and writes down what happens.

    Args:
        loop: around a :class:`HardwareBackend`.
        about: goes into the log's first line.
        command_queue: where somebody may put what is wished: to pause, to go on, another goal. None: nobody can.
    """

    def __init__(self, loop: ClosedLoop, about: dict[str, Any], command_queue: CommandQueue | None = None) -> None:
        if not isinstance(loop.backend, HardwareBackend):
            raise TypeError("a session needs arms and a camera, real or the twin's")
        self.loop, self.backend = loop, loop.backend
        self.command_queue, self.backend.hold = command_queue or CommandQueue(), self._hold
        self.log: EventLog = self.backend.log
        self.printed = PrintedGoal(self.backend)
        """The printed marker, of all episodes."""
        rules = loop.rules
        parked = self.backend.check.homes_rad[0]  # a session's arms are of one robot
        self.log.add(
            Event.SESSION,
            **about,
            cell=asdict(rules.cell.config),
            epsilon_rad=rules.epsilon_rad,
            symmetry_order=rules.config.symmetry_order,
            position_tolerance_mm=rules.config.position_tolerance_mm,
            home_rad=parked,
        )

    def play(self, start: ArrayLike, goals: Goals, seed: int = 0) -> Episode:
        """One episode; ``start`` (3,) is where somebody puts the twin's block; a real one lies where it lies.

        Raises as the backend's ``reset`` and ``execute``, :class:`NoGoal`, and :class:`CannotWrite` of the log.
        """
        asked: list[Floats] = []

        def current() -> Floats:
            """The goal (3,) that is wanted now; a new one is logged."""
            self._hold()
            goal = goals() if self.command_queue.goal is None else self.command_queue.goal
            if not asked or np.abs(goal - asked[-1]).max() > 0:
                self.log.add(Event.GOAL_CHANGED if asked else Event.GOAL, goal=goal)
                asked.append(goal)
            return goal

        self.log.add(Event.EPISODE, seed=seed)
        # A printed goal shows itself at the first look, which play() takes before it asks.
        try:
            episode = self.loop.play(np.asarray(start, float), np.full(3, np.inf), seed, self._note, current)
        except Stopped as stop:
            self.log.add(Event.STOPPED, reason=stop.reason)
            raise
        outcome = episode.outcome.name.lower()
        self.command_queue.goal = None  # the next episode has its own
        self.log.add(Event.ENDED, ended=episode.ended, outcome=outcome, transfers=len(episode.transfers), goal=episode.goal)
        self.log.require_written()
        return episode

    def _hold(self) -> bool:
        """Wait for as long as somebody wants no transfer to begin; whether anybody did. The arms are parked.

        Raises:
            Stopped: the stop is latched.
            CannotWrite: there is no room for the log.
        """
        self.log.require_written()
        self._log_responses()
        if not self.command_queue.paused:
            return False
        self.log.add(Event.PAUSED)
        self.command_queue.wait(self.backend.workcell.driver.check_stop)
        self._log_responses()
        self.log.add(Event.RESUMED)
        return True

    def _log_responses(self) -> None:
        for response in self.command_queue.responses():
            self.log.add(Event.CONTROL, **response._asdict())

    def _note(self, transfer: Transfer) -> None:
        self.log.add(Event.TRANSFER, **transfer_row(transfer, self.loop.rules))


def transfer_line(transfer: Transfer, labels: Sequence[str] = ARM_LETTERS) -> str:
    """A transfer for people; ``labels`` are what they call the cell's arms."""
    command, result = transfer.command, transfer.result
    where = "the goal" if command.final else f"({command.place_mm[0]:z.0f}, {command.place_mm[1]:z.0f})"
    came = result.refusal or f"({result.pose[0]:z.1f}, {result.pose[1]:z.1f}) mm, {np.degrees(result.pose[2]):z.1f} deg"
    return f"  {labels[command.arm]} to {where}: {came}"
