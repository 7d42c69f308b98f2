"""Settings of the arms' electronics, one home for each default; ``configs/hardware/*.yaml`` hold named differences.

What is wired where, how a servo's pulse relates to its joint's angle before anything was measured, what the safety filter lets through,
and what the emulated servos are like.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from marl_handover.config import bounded, check_bounds, chosen, name_field, path_field, require_between, seed_field
from marl_handover.errors import InvalidSetting, listed
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.session_registry import user_path

CHANNELS = 32
PULSE_US = (500, 2500)
READING_US = 10
"""A pulse as boards tell it stands for any from itself to less than this above."""

SPEED_US_S = (1, 65535)
TIME_MS = (1, 65535)
BAUDS = (115200, 38400, 9600, 2400)
"""Rates of the boards' jumpers or button; 9600 is what an SSC-32U comes with, 115200 is what stopping in time needs."""

SERVO_BAUDS = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""Rates of bus servos, by the value of their register."""


class ServoUnit(NamedTuple):
    """What a servo is told: a pulse, in a unit of its own, from ``lower`` to ``upper``; it is told back in steps of ``reading``.

    ``encoders``: what is told back is where the servo stands, not where it was sent.
    """

    name: str
    lower: int
    upper: int
    reading: int
    encoders: bool


COUNTS = 4096
"""Of a full turn of a bus servo."""
COUNTS_PER_RAD = COUNTS / (2 * math.pi)

PROTOCOLS = {"ssc32": ServoUnit("us", *PULSE_US, READING_US, False), "feetech": ServoUnit("counts", 0, COUNTS - 1, 1, True)}
"""What drives servos may speak, and the unit of their pulses: microseconds of a board's, counts of the encoder of a bus servo."""

_WIDEST = (0, COUNTS - 1)
FIRST_MOVES = ("ask", "refuse")
ON_DISCONNECT = ("hold", "limp", "park")
TWIN = "twin"
"""The name of hardware that is emulated, physics and camera included; so is every one whose name ends in ``_twin``."""

ARMS = ("left", "right")
"""Names of the arms of a pair, as it is wired if nothing is said."""
_FILE_NAME, _OTHER_FILES = re.compile(r"[\w-]+"), ("camera", "grippers", "play", "servos")
"""What an arm may be called, and what else is beside the files of the arms."""

MAX_PARK_DEG_S = 90.0
"""Slow enough for a hand to get out of the way; servos can do 260."""


@dataclass
class BoardConfig:
    """One controller board."""

    port: str = ""  # best a path in /dev/serial/by-id; also any pyserial URL; empty: the only FTDI port there is
    baud: int = bounded(115200, 300, 10**7)
    scan: bool = True  # try the board's other rates when nothing answers


@dataclass
class GripperConfig:
    """The gripper is closed by position: to the pin and a little further, never to its end, which strips the servo's gears."""

    channel: int = bounded(4, 0, CHANNELS - 1)
    open_us: int = bounded(1000, *_WIDEST)  # pulse at open_mm; a bus servo's opening follows from the hand's URDF
    closed_us: int = bounded(1900, *_WIDEST)  # pulse at 0 mm; of a bus servo in counts
    open_mm: float = bounded(14.0, 1.0, 50.0)  # how far each finger is from closed there
    preload_mm: float = bounded(0.6, 0.0, 3.0)  # how far into the pin each finger is sent; the servo's softness makes it a force


@dataclass
class ArmWiring:
    """Where an arm's servos are plugged in. A wrong plug shows at the first move: park with the supply's switch in reach."""

    board: str = "main"  # a name in boards
    channels: list[int] = bounded([0, 1, 2, 3, 5], 0, CHANNELS - 1, (1, 32))  # of base_yaw, shoulder, elbow, wrist_pitch, wrist_roll
    gripper: GripperConfig = field(default_factory=GripperConfig)
    pulse_limits_us: list[list[int]] = bounded([list(PULSE_US) for _ in ARM_JOINTS], *PULSE_US, (1, 32), (2, 2))  # [lower, upper] each
    calibration: str = path_field()  # file of calibrate servos; empty: nominal values, good enough to test directions, not to grasp
    lerobot: str = path_field()  # LeRobot's calibration file of an arm of bus servos: where calibrate begins; empty: zeros in the middle


@dataclass
class ServoNominal:
    """A servo before calibration: pulse at the joint's zero, and the change with the angle, negative where it turns the other way."""

    zero_us: float = bounded(1500.0, -5000.0, 8000.0)
    us_per_deg: float = bounded(9.5, -16.0, 16.0)


def _nominal() -> dict[str, ServoNominal]:
    """Horns set so that the middle of each joint's travel is at 1500 us; the elbow turns the other way."""
    return {
        "base_yaw": ServoNominal(1500.0, 9.5),
        "shoulder": ServoNominal(874.0, 9.2),  # 1500 us at 68 degrees
        "elbow": ServoNominal(732.0, -9.2),  # 1500 us at -83.5 degrees
        "wrist_pitch": ServoNominal(1500.0, 9.5),
        "wrist_roll": ServoNominal(1500.0, 10.0),
    }


@dataclass
class SafetyFilterConfig:
    """What the safety filter between plan and wire lets through. Planned motions keep more clearance (``motion.*``) than this."""

    enabled: bool = True
    speed_share: float = bounded(1.0, 0.01, 1.0)  # of the URDF's joint velocities; plans use motion.velocity_scale of them
    step_deg: float = bounded(20.0, 0.1, 90.0)  # greatest change of a joint in one command
    table_clearance_mm: float = bounded(0.5, 0.0, 50.0)  # of every link after the turret
    arm_clearance_mm: float = bounded(3.0, 0.0, 100.0)
    self_clearance_mm: float = bounded(0.0, 0.0, 50.0)
    block_dip_mm: float = bounded(6.0, 0.0, 12.0)  # a held block may be sent this far under the table: aims that take out backlash are
    stale_s: float = bounded(0.25, 0.02, 2.0)  # a command older than this is not sent
    finger_mm: float = bounded(16.0, 1.0, 50.0)  # greatest opening of each finger
    finger_mm_s: float = bounded(95.0, 1.0, 500.0)  # greatest speed of each finger


@dataclass
class StreamConfig:
    """How a motion is sent."""

    period_s: float = bounded(0.06, 0.02, 0.2)  # between group moves; the boards act every 20 ms, so a multiple of that
    poll_s: float = bounded(0.004, 1e-4, 0.01)  # how often the stop is looked at while waiting
    backlog_s: float = bounded(0.002, 0.0, 0.01)  # a move is not written before what is still on the way takes less than this
    late_s: float = bounded(0.3, 0.02, 2.0)  # watchdog: a motion that falls behind by more is given up
    settle_s: float = bounded(0.3, 0.0, 5.0)  # after the last move, for the servos to arrive
    check_reset: bool = True  # ask for all pulses before each group move: none means a reset; another than sent, a board that disobeys
    pulse_tolerance_us: float = bounded(15.0, 5.0, 200.0)  # a pulse may be told so far from what was sent: a servo's dead band is as wide


@dataclass
class TimeoutConfig:
    """Limits of waiting, in s. None is without one: an unpowered board answers never."""

    reply_s: float = bounded(0.1, 0.005, 2.0)  # above FTDI's 16 ms latency and a board's slowest answer
    write_s: float = bounded(0.5, 0.01, 5.0)
    reconnect_s: float = bounded(10.0, 0.1, 600.0)  # how long reconnect() waits for a port to come back
    retries: int = bounded(2, 0, 20)  # of a query that was answered badly


@dataclass
class BusConfig:
    """How bus servos are set, and what of their encoders is believed. Not used by boards."""

    p: int = bounded(32, 1, 254)  # stiffness, as shipped; half of it sags twice as far
    d: int = bounded(32, 0, 254)
    acceleration: int = bounded(254, 1, 254)  # 100 counts/s^2
    lead_deg: float = bounded(3.0, 0.0, 10.0)  # a servo brakes for its goal, so a fast one is sent further, by this much at most
    gripper_torque: int = bounded(500, 50, 1000)  # per mille of the stall torque that a hand closes with
    speed_change_deg_s: float = bounded(100.0, 1.0, 1000.0)  # greatest change of a joint's speed at once: servos do not turn back suddenly
    follow_deg: float = bounded(10.0, 1.0, 45.0)  # a servo this far from where it was sent is held by something, or too weak
    trim_deg: float = bounded(6.0, 0.0, 20.0)  # how far beyond its place a servo is sent at most, so that it does not sag
    trim_share: float = bounded(0.5, 0.0, 1.0)  # part of what a servo sags that each command takes out


@dataclass
class EmulatorConfig:
    """Emulated servos: what they are like, and by how much each differs from the nominal one. Errors are drawn from ``seed``."""

    seed: int = seed_field()
    scale_sd: float = bounded(0.02, 0.0, 0.2)  # relative, of us per degree; cut at two standard deviations, as the offset is
    offset_sd_us: float = bounded(15.0, 0.0, 200.0)
    dead_band_us: float = bounded(8.0, 0.0, 100.0)  # full width; a HS-755HB's
    dead_band_sd_us: float = bounded(3.0, 0.0, 50.0)  # from servo to servo; cut at two standard deviations, as the others are
    lag_s: float = bounded(0.03, 1e-4, 1.0)
    settle_sd_us: float = bounded(1.0, 0.0, 50.0)  # where a servo comes to rest, drawn anew at each stop
    speed_deg_s: list[float] = bounded([333.0, 261.0, 261.0, 300.0, 545.0, 545.0], 1.0, 5000.0)  # at 6 V; the last is the gripper's
    end_stop_deg: float = bounded(5.0, 0.0, 90.0)  # how far beyond the URDF's limits the end stops are
    bus_zero_deg: float = bounded(3.0, 0.0, 45.0)  # zeros of bus servos are anywhere so far off, either way
    bus_play_deg: list[float] = bounded([0.6, 1.3], 0.0, 10.0, (2, 2))  # play of their gears, least and most
    bus_stiffness_share: float = bounded(0.15, 0.0, 0.9)  # how far their stiffness is off at most, relative
    supply_v: float = bounded(7.4, 3.0, 15.0)
    firmware: str = "SSC32-V2.50USB"
    boot_s: float = bounded(0.2, 0.0, 30.0)


def _pair() -> dict[str, ArmWiring]:
    """Two arms on one board."""
    return {"left": ArmWiring(), "right": ArmWiring(channels=[16, 17, 18, 19, 21], gripper=GripperConfig(channel=20))}


def twin_of(name: str) -> str:
    """The name of hardware ``name`` when it is emulated; of hardware that is, its own."""
    if name == TWIN or name.endswith(f"_{TWIN}"):
        return name
    return TWIN if name == HardwareConfig().name else f"{name}_{TWIN}"


@dataclass
class HardwareConfig:
    """The electronics of a cell. One board for a pair of arms is the default; for more boards, name them in ``boards`` and in the arms.

    Arms are wired by their names in the cell. Once an arm of another name is wired, the pair's own wiring no longer counts.
    """

    name: str = name_field("lynxmotion")  # its calibration is kept in a folder of this name
    boards: dict[str, BoardConfig] = field(default_factory=lambda: {"main": BoardConfig()})
    arms: dict[str, ArmWiring] = field(default_factory=_pair)
    protocol: str = chosen("ssc32", tuple(PROTOCOLS))  # what boards speak: ssc32, or feetech: a bus of servos each, channels are their ids
    nominal: dict[str, ServoNominal] = field(default_factory=_nominal)
    gate: SafetyFilterConfig = field(default_factory=SafetyFilterConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    timeouts: TimeoutConfig = field(default_factory=TimeoutConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    emulator: EmulatorConfig = field(default_factory=EmulatorConfig)
    first_move: str = chosen("ask", FIRST_MOVES)  # ask somebody to confirm the parked pose, or refuse to move a board that has no reference
    on_disconnect: str = chosen("hold", ON_DISCONNECT)  # hold (servos stay on), limp (arms sink), park (drive there, then hold)
    park_deg_s: float = bounded(30.0, 1.0, MAX_PARK_DEG_S)  # speed on the way to the parked pose
    stop_file: str = ""  # the latched stop, an absolute path; empty: this user's, /tmp/marl-handover-UID.stop, or .twin.stop
    log_entries: int = bounded(20_000, 1, 1_000_000)  # of the log of every byte; older ones are dropped

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits, or wiring that cannot be."""
        check_bounds(self, "hardware.")
        if self.stop_file and not os.path.isabs(self.stop_file):
            raise InvalidSetting("hardware.stop_file", self.stop_file, "an absolute path: every shell has to find the same file")
        if set(self.nominal) != set(ARM_JOINTS):
            raise InvalidSetting("hardware.nominal", sorted(self.nominal), f"a servo each for {', '.join(ARM_JOINTS)}")
        self._check_plugs(self._meant())
        emulator = self.emulator
        if len(emulator.speed_deg_s) != len(ARM_JOINTS) + 1:
            raise InvalidSetting("hardware.emulator.speed_deg_s", emulator.speed_deg_s, f"{len(ARM_JOINTS) + 1} speeds")
        if not re.search(r"SSC32-V\d+\.\d+", emulator.firmware):
            raise InvalidSetting("hardware.emulator.firmware", emulator.firmware, "SSC32-V and a number, such as SSC32-V2.50USB")

    @property
    def emulated(self) -> bool:
        """Whether these are electronics of a twin."""
        return twin_of(self.name) == self.name

    def for_arms(self, names: Sequence[str] | None = None) -> HardwareConfig:
        """These settings with the wiring of some arms alone, in their order: the k-th of ``arms`` is arm k of the cell.

        Args:
            names: the cell's arms; two of which none is wired by its name are ``left`` and ``right``. None: all that the settings mean.

        Raises:
            InvalidSetting: an arm of the cell is not wired, one is wired that the cell has not, or two plugs are one.
        """
        meant = self._meant()
        wanted = meant if names is None else tuple(names)
        if len(wanted) == 2 and set(meant) == set(ARMS) and not set(wanted) & set(ARMS):
            wanted = ARMS
        if not set(wanted) <= set(self.arms) or not set(meant) <= set(wanted):
            limit = f"wiring of the cell's arms, {listed(wanted)}, each by its name; hardware=FILE.yaml may hold it"
            raise InvalidSetting("hardware.arms", sorted(meant), limit)
        self._check_plugs(wanted)
        return replace(self, arms={name: self.arms[name] for name in wanted})

    @property
    def unit(self) -> ServoUnit:
        """Of every pulse in these settings."""
        return PROTOCOLS[self.protocol]

    def pulse_limits(self, arm: str) -> list[list[int]]:
        """Least and greatest pulse of each joint of an arm."""
        return self.arms[arm].pulse_limits_us if self.protocol == "ssc32" else [[self.unit.lower, self.unit.upper] for _ in ARM_JOINTS]

    def require_grip(self, pin_diameter_mm: float) -> None:
        """Raise :class:`InvalidSetting` for fingers that would close to their end, whatever is between them: that strips gears."""
        for name, wiring in self.arms.items():
            preload_mm = wiring.gripper.preload_mm
            if preload_mm >= pin_diameter_mm / 2:
                limit = f"below {pin_diameter_mm / 2:g}, half of cell.block.pin_diameter_mm: fingers never close to their end"
                raise InvalidSetting(f"hardware.arms.{name}.gripper.preload_mm", preload_mm, limit)

    def _meant(self) -> tuple[str, ...]:
        """Names of the arms that are wired: the pair as it is shipped gives way to arms of other names."""
        usual = _pair()
        if set(self.arms) <= set(usual):
            return tuple(name for name in usual if name in self.arms)
        return tuple(name for name, wiring in self.arms.items() if usual.get(name) != wiring)

    def _check_plugs(self, names: Sequence[str]) -> None:
        """Raise :class:`InvalidSetting` for wiring of the arms ``names`` that cannot be."""
        for name in names:
            self._check_arm(f"hardware.arms.{name}", self.arms[name])
        ports: dict[str, str] = {}
        for board in dict.fromkeys(self.arms[name].board for name in names):
            baud, port = self.boards[board].baud, self.boards[board].port
            bauds = BAUDS if self.protocol == "ssc32" else SERVO_BAUDS
            if baud not in bauds:
                raise InvalidSetting(f"hardware.boards.{board}.baud", baud, f"one of {', '.join(map(str, bauds))}")
            if port and port in ports:
                raise InvalidSetting(f"hardware.boards.{board}.port", port, f"another port than that of board {ports[port]}")
            ports[port] = board
            taken = [channel for name in names if self.arms[name].board == board for channel in self.channels(name)]
            if len(set(taken)) != len(taken):
                raise InvalidSetting(f"channels of board {board}", taken, "each used once")

    def _check_arm(self, name: str, arm: ArmWiring) -> None:
        if not _FILE_NAME.fullmatch(name.rpartition(".")[2]) or name.rpartition(".")[2] in _OTHER_FILES:
            limit = f"a name of letters, digits, _ and -, and none of {', '.join(_OTHER_FILES)}: its calibration is a file of that name"
            raise InvalidSetting("an arm of the hardware", name.rpartition(".")[2], limit)
        if arm.board not in self.boards:
            raise InvalidSetting(f"{name}.board", arm.board, f"one of hardware.boards: {', '.join(self.boards)}")
        if len(arm.channels) != len(ARM_JOINTS) or not all(0 <= channel < CHANNELS for channel in arm.channels):
            raise InvalidSetting(f"{name}.channels", arm.channels, f"{len(ARM_JOINTS)} channels, each 0 to {CHANNELS - 1}")
        limits = arm.pulse_limits_us
        if len(limits) != len(ARM_JOINTS) or not all(len(pair) == 2 and PULSE_US[0] <= pair[0] < pair[1] <= PULSE_US[1] for pair in limits):
            raise InvalidSetting(f"{name}.pulse_limits_us", limits, f"a pair [lower, upper] a joint, within {PULSE_US[0]} to {PULSE_US[1]}")
        gripper, unit = arm.gripper, self.unit
        for key in ("closed_us", "open_us") if self.protocol == "ssc32" else ("closed_us",):
            require_between(f"{name}.gripper.{key}", getattr(gripper, key), unit.lower, unit.upper)
        if gripper.open_us == gripper.closed_us:
            raise InvalidSetting(f"{name}.gripper.open_us", gripper.open_us, "another pulse than closed_us")

    def used_boards(self) -> tuple[str, ...]:
        """Names of the boards that an arm is wired to, in the order of the arms."""
        return tuple(dict.fromkeys(wiring.board for wiring in self.arms.values()))

    def channels(self, arm: str) -> tuple[int, ...]:
        """An arm's channels, the gripper's last."""
        return (*self.arms[arm].channels, self.arms[arm].gripper.channel)

    def stop_path(self) -> str:
        """The file whose presence is the latched stop. The same for every session of a user, wherever it was started.

        The twin has one of its own: what stops real arms does not keep it from moving, and the other way round.
        """
        return self.stop_file or str(user_path(".twin.stop" if self.emulated else ".stop"))
