"""What a physics engine does for the simulated cell. Each engine is one file, found by its name; nothing here knows any of them."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Never, Protocol

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.config import ENGINES, BlockConfig
from marl_handover.errors import HandoverError, MissingExtra, WorkFailed
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.se2 import SE2
from marl_handover.simulation.camera import Camera, Pixels

TABLE, BLOCK = -1, -2
"""Bodies that touch are an arm's number, or one of these."""


class NoWindow(WorkFailed):
    """The engine cannot open its window."""

    exit_status = 2

    def __init__(self, engine: str) -> None:
        super().__init__(f"gui = true: the window of {engine} needs a display, and DISPLAY is not set; use gui=false, and video=FILE")


class NoRenderer(HandoverError):
    """Nothing on this machine can draw the engine's pictures."""

    def __init__(self, engine: str) -> None:
        super().__init__(f"pictures of {engine} need OpenGL (EGL or OSMesa), or PyBullet; run: apt-get install libegl1 libgl1-mesa-dri")


class WorldClosed(WorkFailed):
    """A simulated world is used after it was closed."""

    def __init__(self) -> None:
        super().__init__("this simulated world was closed; make a new environment")


class WorldNotCopied(HandoverError, TypeError):
    """A simulated world is to be copied or pickled."""

    def __init__(self) -> None:
        super().__init__("a simulated world cannot be copied or pickled; make another environment, and reset it with the same seed")


class NotCopied:
    """What owns a world, and so cannot be copied: two would share one."""

    def __reduce__(self) -> Never:
        raise WorldNotCopied()


class Units(NamedTuple):
    """Lengths of an engine's world, which may be blown up by ``scale``. Masses and seconds stay, so forces grow by it, torques and inertias
    by its square.
    """

    scale: float = 1.0

    def length(self, mm: float) -> float:
        """Millimetres as the world's length."""
        return mm * (self.scale / 1000.0)

    def to_mm(self, world: Iterable[float]) -> Floats:
        """World lengths as millimetres."""
        return np.asarray(list(world), dtype=float) / (self.scale / 1000.0)

    def force(self, newtons: float) -> float:
        """A force as the world has it."""
        return newtons * self.scale

    def torque(self, newton_metres: float) -> float:
        """A torque as the world has it."""
        return newton_metres * self.scale**2

    def inertia(self, kg_mm2: float) -> float:
        """A moment of inertia as the world has it."""
        return kg_mm2 * 1e-6 * self.scale**2


class Touch(NamedTuple):
    """Two links that touch, by name; the block and the table have none. ``distance_mm`` is negative where they overlap."""

    first: str
    second: str
    distance_mm: float
    force_n: float


class Servo(NamedTuple):
    """A joint that is driven: the engine's number of it, and the most that its motor does, in the engine's units."""

    joint: int
    effort: float
    velocity: float


class Scene(NamedTuple):
    """What stands in a world.

    ``passes``: of each arm, whether nothing comes of touches between its hand and the block. ``table_mm``: half of the table's side.
    """

    arms: Sequence[ArmModel]
    bases: Sequence[SE2]
    block: BlockConfig
    passes: Sequence[bool]
    table_mm: float = 1000.0


class Engine(Protocol):
    """A world of its own, with a table, arms and the block in it. Several live side by side in one process.

    Equal calls after :meth:`reset` give bit-identical states. A world is let go when it is closed or nobody holds it any more, and it
    cannot be copied. Every method raises :class:`WorldClosed` after :meth:`close`. Joint values, lengths, speeds and forces that servos
    have are in the engine's :attr:`units`; everything else is in mm, rad and N.

    Made of a :class:`Scene`, and of whether a window is to open; raises :class:`NoWindow` if that cannot be, :class:`UrdfError` for an arm
    that the engine cannot take.
    """

    units: Units
    time_s: float
    """How much time has passed."""

    def __init__(self, scene: Scene, gui: bool = False) -> None: ...

    def reset(self) -> None:
        """The world as if it had just been made, at time 0: nothing of what went before is left to influence what comes."""

    def fine(self, fine: bool) -> None:
        """Cut time from now on for fingers on a thin pin; or coarsely, for arms in free air and a block that stands."""

    def advance(self, seconds: float) -> None:
        """Let time pass, in whole steps."""

    def close(self) -> None:
        """Let the world go; a second call does nothing."""

    def joint(self, arm: int, name: str) -> int:
        """The engine's number of an arm's joint."""

    def set_joint(self, arm: int, joint: int, value: float) -> None:
        """Put a joint there at rest, without moving through the room."""

    def drive(self, arm: int, servo: Servo, position: float, velocity: float, gain: float) -> None:
        """A set-point of a servo: where its joint should be, its speed from there; ``gain``: part of an error that it removes in a step."""

    def joint_values(self, arm: int, joints: Sequence[int]) -> list[float]:
        """Where joints are."""

    def grip_mm(self, arm: int) -> Floats:
        """Where an arm's grasp frame is in the world (3,)."""

    def put_block(self, xyz_mm: Sequence[float], rpy_rad: Sequence[float]) -> None:
        """Put the block's frame there (3,), turned by roll, pitch and yaw (3,), at rest."""

    def block_transform(self) -> Floats:
        """T_world_block (4, 4) in mm, wherever it is, upright or not."""

    def touches(self, first: int, second: int, link: str | None = None) -> list[Touch]:
        """Where two bodies touched in the last step; ``link``: only where this one of the first did."""

    def bond(self, arm: int) -> None:
        """A rigid joint between an arm's hand and the block as they are now."""

    def release(self, arm: int) -> None:
        """Take the rigid joint away."""

    def picture(self, camera: Camera, width: int, height: int) -> Pixels:
        """What ``camera`` sees now: RGB (height, width, 3). Raises :class:`NoRenderer`."""

    def lay(self, one_mm: Floats, other_mm: Floats, height_mm: float, rgb: ArrayLike) -> None:
        """A flat strip between two edges (n, 2), to be seen only, until the next reset."""

    def paint_base(self, arm: int, rgb: ArrayLike) -> None:
        """Colour an arm's base and what turns on it, until the next reset."""

    def save(self) -> Any:
        """All that the future depends on, for :meth:`restore` of this world until its next reset."""

    def restore(self, state: Any) -> None:
        """Go back to what :meth:`save` gave. Nothing has touched anything yet."""


def default_engine() -> str:
    """The engine that is taken where none is named: PyBullet where it is installed, else MuJoCo."""
    return "bullet" if importlib.util.find_spec("pybullet") else "mujoco"


def open_engine(name: str | None, scene: Scene, gui: bool = False) -> Engine:
    """A world of the engine ``name``; None: :func:`default_engine`.

    Raises:
        UnknownChoice: there is no such engine.
        MissingExtra: it is not installed.
        NoWindow, UrdfError: as the engine does.
    """
    engine: Engine = ENGINES[name or default_engine()](scene, gui)
    return engine


def require_display(engine: str) -> None:
    """Raise :class:`NoWindow` where a window cannot be opened."""
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise NoWindow(engine)


def missing_engine(name: str, package: str) -> MissingExtra:
    """What is said of an engine that is not installed."""
    return MissingExtra(f"the physics engine {name}", package, name)
