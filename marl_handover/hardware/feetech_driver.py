"""Bus servos as what drives an arm: their encoders say where they stand, and what they sag is taken out.

A servo is told where to go every few hundredths of a second, with a speed that is little above what it needs, so that it never jumps.
It stands short of its place where gravity pulls; its encoder is on the output shaft, so each command aims further by what is missing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple, Unpack

from marl_handover.hardware.clock import Clock
from marl_handover.hardware.errors import (
    NoReference,
    PulseMismatch,
    ServoAstray,
    ServoFault,
    TorqueLost,
    UnsuitableFirmware,
)
from marl_handover.hardware.feetech import MODEL, FeetechBus, Status, sync_write, words
from marl_handover.hardware.settings import COUNTS, PROTOCOLS, BoardConfig, BusConfig, TimeoutConfig
from marl_handover.hardware.transport import BITS_PER_BYTE, DeviceOptions, LineRecord

LAG_S = 0.03
"""A servo is about so far behind its set point: its own softness, and the bus."""

_WATCHED_S = 0.25
"""A servo has to be between the places where it was sent in the last so many seconds."""

_SLOW = 150.0
"""Counts per second: of a servo this fast half as much is believed about what it sags, and ever less of a faster one."""

_MIN_SPEED, _SPARE = 120, 1.3
"""Counts per second that a servo may always use, and how much faster than its set point it may be, to catch up."""

_MOVE = ("goal_position", "goal_time", "goal_speed")
_STATE = ("torque_enable", "goal_position", "present_position", "status", "present_speed")
_LONGEST_BYTES = 400
_PHASE_WRAPS = 16

_ENDURING = {"return_delay": 0, "response_level": 1, "mode": 0, "i": 0}
"""What every servo is set to, beside its gains. No I: this module takes out what it would, and says how much at most."""

_GRIPPER = {"protection_current": 250, "overload_torque": 25}


class _Course(NamedTuple):
    """A set point on its way, straight; there before and after."""

    start: float
    target: float
    begin_s: float
    end_s: float

    def at(self, t_s: float) -> float:
        if t_s >= self.end_s:
            return self.target
        return self.start + max(t_s - self.begin_s, 0.0) / (self.end_s - self.begin_s) * (self.target - self.start)

    @property
    def speed(self) -> float:
        return abs(self.target - self.start) / (self.end_s - self.begin_s) if self.end_s > self.begin_s else 0.0


class FeetechDriver(FeetechBus):
    """The servos of one bus that arms are wired to.

    Args:
        name: of the bus in the settings.
        config: its port and rate.
        timeouts: limits of waiting.
        clock: time.
        servos: ids of all that have to be there.
        grippers: those of them that hold something: they may be kept from where they are sent.
        settings: how servos are set.
        options: see :class:`~marl_handover.hardware.transport.WiredDevice`.
    """

    has_encoders = True
    """Where a servo stands is known whether it holds or not: its first move is no jump."""

    def __init__(
        self,
        name: str,
        config: BoardConfig,
        timeouts: TimeoutConfig,
        clock: Clock,
        *,
        servos: Sequence[int],
        grippers: Collection[int],
        settings: BusConfig,
        **options: Unpack[DeviceOptions],
    ) -> None:
        super().__init__(name, config, timeouts, clock, **options)
        self._servos, self._grippers, self._settings = list(servos), frozenset(grippers), settings
        self._courses: dict[int, deque[_Course]] = {}
        self._goals: dict[int, int] = {}
        self._trims: dict[int, float] = {}
        self._untried: set[int] = set()
        self._seen: dict[int, int] = {}

    def connect(self) -> None:
        """Find the servos, see that they are what they should be, and set what lasts where it differs.

        Raises:
            PortNotFound: there is no port, or it is in use.
            ServoMissing: some do not answer; the message says who does.
            DuplicateServo: two have one id.
            UnsuitableFirmware: one is no STS3215, or their firmwares differ.
            ServoFault: one reports trouble, such as a supply of the wrong voltage.
        """
        models = self.open(self._servos)
        try:
            for servo, model in models.items():
                if model != MODEL:
                    raise UnsuitableFirmware(self.wire.port, f"model {model}", f"servo {servo} is no STS3215, which is model {MODEL}")
            firmwares = self.read_all("firmware", self._servos)
            if len(set(firmwares.values())) > 1:
                said = ", ".join(f"{servo}: {value & 0xFF}.{value >> 8}" for servo, value in firmwares.items())
                raise UnsuitableFirmware(self.wire.port, said, "the servos of one bus must have one firmware; update them")
            self._require_supply()
            if not self.dry_run:
                for servo in self._servos:
                    self.configure(servo, self._wanted(servo))
        except BaseException:
            self.close()
            raise
        self._forget()

    def close(self) -> None:
        """Let the port go; servos keep what they do. Again is fine."""
        super().close()
        self._forget()

    def pulses(self, channels: Iterable[int]) -> dict[int, int | None]:
        """Where servos stand, in counts, whether they hold or not."""
        return dict(self.read_all("present_position", list(channels)))

    def marks(self, channels: Iterable[int]) -> tuple[int, ...]:
        """Homing offsets, which every arm has of its own and keeps."""
        return tuple(self.read_all("homing_offset", list(channels)).values())

    def limp(self, channels: Iterable[int]) -> list[int]:
        """Servos whose torque is off."""
        return [servo for servo, on in self.read_all("torque_enable", list(channels)).items() if not on]

    def require_pulses(self, channels: Iterable[int], tolerance: float = 0.0) -> None:
        """Ask whether servos stand where they were sent by now, and learn what they sag. Nothing is asked in a dry run.

        ``tolerance`` is that of boards, and not used: encoders tell the truth, and how far servos may be behind is ``bus.follow_deg``.

        Raises:
            TorqueLost: servos do not hold: the supply broke down.
            ServoFault: one reports an overload, or other trouble.
            PulseMismatch: one is held by something, or too weak.
            ServoMissing: one does not answer.
        """
        listed = list(channels)
        if self.dry_run:
            return
        try:
            present = self._well(listed)
        except (TorqueLost, ServoFault, PulseMismatch):
            try:  # a damaged answer may look like a whole one: bad news is believed when it comes twice
                present = self._well(listed)
            except TorqueLost as lost:
                self._forget(lost.servos)  # nothing is to be sent to these: a goal would switch them on, at full speed
                raise
        for servo in listed:
            if servo in self._untried and servo not in self._grippers:
                self._learn(servo, *present[servo])

    def _well(self, listed: Sequence[int]) -> dict[int, tuple[int, int]]:
        """Where servos stand, and their speeds. Raises as :meth:`require_pulses`."""
        state = self.read_group(_STATE, listed)
        now_s = self._clock.now_s()
        limp = [servo for servo in listed if not state[servo][0]]
        if limp:
            raise TorqueLost(self.name, limp)
        for servo in listed:
            if status := Status(state[servo][3]):
                raise ServoFault(self.name, servo, words(status))
        self._seen.update({servo: state[servo][2] for servo in listed})
        for servo in listed:
            if servo not in self._grippers and servo in self._courses:
                self._compare(servo, state[servo][2], now_s)
        return {servo: (state[servo][2], state[servo][4]) for servo in listed}

    def note_readback(self, pulses: Mapping[int, int]) -> None:
        """Take readings of servos that stand still for where they were sent."""
        for servo, pulse in pulses.items():
            self._courses[servo] = deque([_Course(pulse, pulse, 0.0, 0.0)], maxlen=16)
            # A hand is kept from where it is sent by what it holds: that is nothing to be taken out.
            self._trims[servo] = 0.0 if servo in self._grippers else self._bounded(self._goals.get(servo, pulse) - pulse)

    def first_move(self, pulses: Mapping[int, int], time_ms: int | None) -> LineRecord:
        """Hold servos where they stand, which ``pulses`` says. One that holds already keeps its goal, and so what it was trimmed by.

        Raises :class:`ServoFault` for one whose trouble does not go away when its torque is switched off.
        """
        state = self.read_group(_STATE, list(pulses))
        troubled = [servo for servo, row in state.items() if row[3]]
        if troubled and not self.dry_run:
            self.write_all(("torque_enable",), {servo: (0,) for servo in troubled})
        goals = {}
        for servo, pulse in pulses.items():
            holds, goal, _, status, _ = state[servo]
            kept = goal if holds and not status and abs(goal - pulse) <= self._most_trim else pulse
            goals[servo] = kept
        self._goals.update(goals)
        self.note_readback(pulses)
        sent = self._send(sync_write(_MOVE, {servo: (goal, 0, _MIN_SPEED) for servo, goal in goals.items()}))
        if not self.dry_run:
            self.write_all(("torque_enable",), {servo: (1,) for servo in goals})
            self._require_well(list(goals))
        return sent

    def move(
        self, pulses: Mapping[int, int], time_ms: int, speeds: Mapping[int, int] | None = None, aims: Mapping[int, int] | None = None
    ) -> LineRecord:
        """Move servos together, each at most at its speed in counts/s; a :class:`NoReference` if any of them is not held.

        ``aims``: goals further on than ``pulses``, so that servos do not brake; they stay there if nothing follows.
        """
        unknown = [servo for servo in pulses if servo not in self._courses]
        if unknown:
            raise NoReference(self.name, unknown)
        now_s, duration_s, goals = self._clock.now_s(), time_ms / 1000, {}
        for servo, pulse in pulses.items():
            start = self._set_point(servo, now_s)
            course = _Course(start, float(pulse), now_s, now_s + duration_s)
            before = self._courses[servo][-1].speed
            self._courses[servo].append(course)
            most = (speeds or {}).get(servo, COUNTS)
            speed = min(max(math.ceil(_SPARE * max(course.speed, before)), _MIN_SPEED), max(most, 1))
            self._goals[servo] = self._goal(servo, pulse if aims is None else aims[servo])
            self._untried.add(servo)
            goals[servo] = (self._goals[servo], 0, speed)
        return self._send(sync_write(_MOVE, goals))

    def correct(self) -> None:
        """Send servos that stand still as much further as they lack, as far as :meth:`require_pulses` has learnt it."""
        now_s = self._clock.now_s()
        still = [servo for servo, courses in self._courses.items() if servo not in self._grippers and courses[-1].end_s <= now_s]
        goals = {servo: self._goal(servo, self._set_point(servo, now_s)) for servo in still}
        changed = {servo: (goal, 0, _MIN_SPEED) for servo, goal in goals.items() if goal != self._goals.get(servo)}
        if changed:
            self._send(sync_write(_MOVE, changed))
        self._goals.update(goals)
        self._untried.update(still)

    def stop(self, channels: Iterable[int]) -> LineRecord:
        """Hold servos where their set points are now; one that is far from there, where it was seen last.

        Written even in a dry run, and twice: an answer under way may have hit the first.
        """
        wire, listed, now_s = self.wire, list(channels), self._clock.now_s()
        places = {servo: self._set_point(servo, now_s) for servo in listed if servo in self._courses}
        for servo, place in places.items():
            if servo not in self._grippers and abs(self._seen.get(servo, place) - place) > self._most_off:
                places[servo] = float(self._seen[servo])
        held = {servo: self._goal(servo, place) for servo, place in places.items()}
        if not held:
            return LineRecord(self.name, now_s, b"", True)
        data = sync_write(("goal_position",), {servo: (goal,) for servo, goal in held.items()})
        written_s = wire.write(data)
        for servo, goal in held.items():
            place = places[servo]
            self._courses[servo].append(_Course(place, place, now_s, now_s))
            self._goals[servo] = goal
        self._clock.sleep_s(self._longest_answer_s())
        wire.write(data)
        return LineRecord(self.name, written_s, data, True)

    def torque_off(self, channels: Iterable[int]) -> LineRecord:
        """Let servos go: arms sink, but for a dry run. The next move is a first one."""
        listed = list(channels)
        self._forget(listed)
        return self._send(sync_write(("torque_enable",), {servo: (0,) for servo in listed}))

    def stop_s(self, channels: Sequence[int]) -> float:
        """How long a stop is on the wire at worst: it waits for the longest line."""
        return (_LONGEST_BYTES + 10 + 3 * len(channels)) * BITS_PER_BYTE / self.wire.baud

    @property
    def _most_off(self) -> float:
        return self._settings.follow_deg * COUNTS / 360

    @property
    def _most_trim(self) -> float:
        return self._settings.trim_deg * COUNTS / 360

    def _longest_answer_s(self) -> float:
        return 0.5 * _LONGEST_BYTES * BITS_PER_BYTE / self.wire.baud

    def _wanted(self, servo: int) -> dict[str, int]:
        """Lasting registers as they should be."""
        wanted = {**_ENDURING, "p": self._settings.p, "d": self._settings.d}
        phase = self.read(servo, "phase")
        wanted["phase"] = phase & ~_PHASE_WRAPS
        if servo in self._grippers:
            wanted |= _GRIPPER | {"max_torque": self._settings.gripper_torque}
        return wanted

    def _require_supply(self) -> None:
        """Raise :class:`ServoFault` for a servo whose supply is out of what it is made for; a 7.4 V one on 12 V burns."""
        for servo in self._servos:
            if Status.VOLTAGE in self.ping(servo):
                volts = self.read(servo, "present_voltage") / 10
                low, high = (self.read(servo, name) / 10 for name in ("min_voltage", "max_voltage"))
                raise ServoFault(self.name, servo, f"{words(Status.VOLTAGE)}: {volts:g} V, made for {low:g} to {high:g} V")

    def _require_well(self, servos: Sequence[int]) -> None:
        for servo, (_, _, _, status, _) in self.read_group(_STATE, servos).items():
            if status:
                raise ServoFault(self.name, servo, words(Status(status)))

    def _set_point(self, servo: int, t_s: float) -> float:
        return self._courses[servo][-1].at(t_s)

    def _goal(self, servo: int, pulse: float) -> int:
        unit = PROTOCOLS["feetech"]
        return min(max(round(pulse + self._trims.get(servo, 0.0)), unit.lower), unit.upper)

    def _compare(self, servo: int, present: int, now_s: float) -> None:
        """See that a servo follows."""
        courses = self._courses[servo]
        recent = [course for course in courses if course.end_s >= now_s - _WATCHED_S] or [courses[-1]]
        places = [at for course in recent for at in (course.at(now_s - _WATCHED_S), course.at(now_s))]
        off = max(min(places) - present, present - max(places), 0.0)
        if off > self._most_off:
            wanted = (min(places), max(places))
            raise ServoAstray(self.name, servo, present, wanted, self._most_off)

    def _learn(self, servo: int, present: int, speed: int) -> None:
        """Aim further next time by what a servo lacks, the less the faster it goes, or should go. What was learnt is first tried out."""
        self._untried.discard(servo)
        then_s = self._clock.now_s() - LAG_S
        courses = self._courses[servo]
        course = next((course for course in reversed(courses) if course.begin_s <= then_s), courses[0])
        share = self._settings.trim_share / (1 + (max(course.speed, abs(speed)) / _SLOW) ** 2)
        self._trims[servo] = self._bounded(self._trims.get(servo, 0.0) + share * (course.at(then_s) - present))

    def _bounded(self, trim: float) -> float:
        return min(max(trim, -self._most_trim), self._most_trim)

    def _forget(self, servos: Iterable[int] | None = None) -> None:
        for servo in list(self._courses if servos is None else servos):
            for known in (self._courses, self._trims, self._goals, self._seen):
                known.pop(servo, None)
