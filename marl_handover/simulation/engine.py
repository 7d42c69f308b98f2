"""One PyBullet world of its own, its constants, and the change of units between it and the package.

The world is blown up by :data:`SCALE`: Bullet's collision tolerances are made for bodies of decimetres, and a pin 2.5 mm thick is finer
than they are. Only this module knows the factor. Masses and seconds stay, so forces grow by it, torques and inertias by its square.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, Never

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import HandoverError, UrdfError, WorkFailed


@contextmanager
def _silent() -> Iterator[None]:
    """Nothing that C code prints in this block comes out; what was printed before does, and in its order."""
    try:
        kept = {number: os.dup(number) for number in (1, 2)}
    except OSError:  # no standard streams, nothing to silence
        yield
        return
    _flush()
    try:
        with open(os.devnull, "wb") as nowhere:
            for number in kept:
                os.dup2(nowhere.fileno(), number)
        yield
    finally:
        _flush()
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)


def _flush() -> None:
    """Empty the buffers of Python's streams and of C's."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    with suppress(OSError, TypeError, AttributeError):  # a system without a C library in the process
        ctypes.CDLL(None).fflush(None)


with _silent():  # it prints when it was built; the package's other modules take it from here
    import pybullet

Floats = NDArray[np.float64]

SCALE = 10.0
_UNITS_PER_MM = SCALE / 1000.0


class Pace(NamedTuple):
    """How finely time is cut, and how long the solver works on each piece."""

    step_s: float
    iterations: int


COARSE = Pace(1 / 250, 50)
"""For arms that move in free air, and a block that stands."""

FINE = Pace(1 / 1000, 300)
"""For fingers on a thin pin: with less, the solver's leftover forces turn the block in the grip when the hand pitches on the way."""

_GRAVITY_M_S2 = 9.81


class NoWindow(WorkFailed):
    """PyBullet cannot open its window."""

    exit_status = 2

    def __init__(self) -> None:
        super().__init__("gui = true: PyBullet's window needs a display, and DISPLAY is not set; use gui=false, and video=FILE")


class WorldClosed(WorkFailed):
    """A simulated world is used after it was closed."""

    def __init__(self) -> None:
        super().__init__("this simulated world was closed; make a new environment")


class WorldNotCopied(HandoverError, TypeError):
    """A simulated world is to be copied or pickled."""

    def __init__(self) -> None:
        super().__init__("a simulated world cannot be copied or pickled; make another environment, and reset it with the same seed")


class Surface(NamedTuple):
    """Friction of a body's surface; Bullet multiplies the lateral values of two that touch.

    ``patch_mm`` stands for the radius of a soft contact patch, which resists rolling and spinning.
    """

    lateral: float
    patch_mm: float = 0.0


class Touch(NamedTuple):
    """Two links that touch; link -1 is a body's base. ``distance_mm`` is negative where they overlap."""

    first: tuple[int, int]
    second: tuple[int, int]
    distance_mm: float
    force_n: float


class Engine:
    """A physics client. Several live side by side in one process; each call names its own.

    It is let go when the engine is closed or nobody holds it any more. It cannot be copied: two engines would share one world.

    Raises:
        NoWindow: if ``gui`` and there is no display.
    """

    def __init__(self, gui: bool = False) -> None:
        # Without a display PyBullet does not fail, it ends the process.
        if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            raise NoWindow()
        try:
            client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        except pybullet.error as error:
            raise NoWindow() from error
        if client < 0:
            raise NoWindow()
        self._client = client
        self._connection = weakref.finalize(self, _disconnect, client)
        self.time_s = 0.0

    @property
    def client(self) -> int:
        """The number by which PyBullet knows this world. It gives the number to another world later.

        Raises:
            WorldClosed: after :meth:`close`.
        """
        if not self._connection.alive:
            raise WorldClosed()
        return self._client

    def __reduce__(self) -> Never:
        raise WorldNotCopied()

    def clear(self) -> None:
        """An empty world at time 0, as if just connected: nothing of what went before is left to influence what comes."""
        pybullet.resetSimulation(physicsClientId=self.client)
        pybullet.setGravity(0, 0, -_GRAVITY_M_S2 * SCALE, physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(numSubSteps=0, deterministicOverlappingPairs=1, physicsClientId=self.client)
        self.pace(COARSE)
        self.time_s = 0.0

    def pace(self, pace: Pace) -> None:
        """Cut time this finely from now on."""
        self._step_s = pace.step_s
        pybullet.setPhysicsEngineParameter(fixedTimeStep=pace.step_s, numSolverIterations=pace.iterations, physicsClientId=self.client)

    def advance(self, seconds: float) -> None:
        """Let time pass, in whole steps."""
        steps = round(seconds / self._step_s)
        client = self.client
        for _ in range(steps):
            pybullet.stepSimulation(physicsClientId=client)
        self.time_s += steps * self._step_s

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        self._connection()

    def load_arm(self, path: Path, x_mm: float, y_mm: float, yaw_rad: float, *, touches_itself: bool = True) -> int:
        """A URDF with its base fixed to the table; gives the body's number. ``touches_itself``: whether its links stop each other.

        Raises:
            UrdfError: PyBullet cannot load it.
        """
        try:
            body = pybullet.loadURDF(
                str(path),
                basePosition=[length(x_mm), length(y_mm), 0.0],
                baseOrientation=pybullet.getQuaternionFromEuler([0.0, 0.0, yaw_rad]),
                useFixedBase=True,
                globalScaling=SCALE,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE | (pybullet.URDF_USE_SELF_COLLISION if touches_itself else 0),
                physicsClientId=self.client,
            )
        except pybullet.error as error:
            raise UrdfError(path, "PyBullet cannot load it; every mesh it names has to be there, as .obj, .stl or .dae") from error
        for link in range(pybullet.getNumJoints(body, physicsClientId=self.client)):
            # globalScaling leaves inertias as the file has them.
            inertia = pybullet.getDynamicsInfo(body, link, physicsClientId=self.client)[2]
            self.dynamics(body, link, localInertiaDiagonal=[SCALE**2 * value for value in inertia], linearDamping=0.0, angularDamping=0.0)
        return int(body)

    def dynamics(self, body: int, link: int, **changes: Any) -> None:
        """``changeDynamics`` in this client; values in the world's own units."""
        pybullet.changeDynamics(body, link, physicsClientId=self.client, **changes)

    def coat(self, body: int, links: Iterable[int], surface: Surface) -> None:
        """Give links of a body a surface."""
        for link in links:
            self.dynamics(
                body,
                link,
                lateralFriction=surface.lateral,
                spinningFriction=length(surface.patch_mm),
                rollingFriction=length(surface.patch_mm),
            )

    def touches(self, first: int, second: int, first_link: int | None = None) -> list[Touch]:
        """Where two bodies touched in the last step."""
        only = {} if first_link is None else {"linkIndexA": first_link}
        found = pybullet.getContactPoints(bodyA=first, bodyB=second, physicsClientId=self.client, **only) or ()
        return [Touch((hit[1], hit[3]), (hit[2], hit[4]), hit[8] / _UNITS_PER_MM, hit[9] / SCALE) for hit in found]


def _disconnect(client: int) -> None:
    with suppress(pybullet.error):  # whose window was closed by hand
        pybullet.disconnect(physicsClientId=client)


def length(mm: float) -> float:
    """Millimetres as the world's length."""
    return mm * _UNITS_PER_MM


def to_mm(world: Iterable[float]) -> Floats:
    """World lengths as millimetres."""
    return np.asarray(list(world), dtype=float) / _UNITS_PER_MM


def force(newtons: float) -> float:
    """A force as the world has it."""
    return newtons * SCALE


def torque(newton_metres: float) -> float:
    """A torque as the world has it."""
    return newton_metres * SCALE**2


def inertia(kg_mm2: float) -> float:
    """A moment of inertia as the world has it."""
    return kg_mm2 * 1e-6 * SCALE**2


def tilt_of(quaternion: Iterable[float]) -> float:
    """Angle between a body's z axis and the vertical."""
    rotation = pybullet.getMatrixFromQuaternion(list(quaternion))
    return math.acos(min(1.0, max(-1.0, rotation[8])))
