"""The cell's world in MuJoCo.

A servo is a torque: what brings its joint to the speed it should have within one step, as far as its effort goes. Arms do not touch
themselves.
"""

from __future__ import annotations

import atexit
import importlib
import os
import sys
from collections.abc import Sequence
from ctypes.util import find_library
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.config import ENGINES
from marl_handover.errors import MissingExtra, UrdfError, first_line
from marl_handover.geometry.se3 import rpy_of, transform
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.simulation.camera import NEAR_MM, Camera, Pixels, far_mm, frustum_mm
from marl_handover.simulation.engine import (
    BLOCK,
    TABLE,
    Engine,
    NoRenderer,
    NotCopied,
    NoWindow,
    Scene,
    Servo,
    Touch,
    Units,
    WorldClosed,
    missing_engine,
    require_display,
)
from marl_handover.simulation.mjcf import BLOCK_BODY, WORLD_BODY, Look, Strip, bond_name, mjcf, named

try:
    import mujoco
except ModuleNotFoundError as error:
    raise missing_engine("mujoco", "mujoco") from error

UNITS = Units()
_MM = 1e-3

COARSE_S, FINE_S = 1 / 500, 1 / 1000
"""Steps in free air, and with fingers on a thin pin."""

_FRAME_S = 0.02
"""How often a window shows what is new."""

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
_MOST_SHAPES = 4000


class MujocoEngine(NotCopied):
    """A model and its data: an :class:`~marl_handover.simulation.engine.Engine`."""

    units = UNITS

    def __init__(self, scene: Scene, gui: bool = False) -> None:
        self.scene, self.time_s = scene, 0.0
        self._model = model = _compiled(scene, None)
        self._data = mujoco.MjData(model)
        self._closed = False
        self._owner, self._link = _owners(model)
        self._names = {model.joint(joint).name for joint in range(model.njnt)}
        self._driven = model.nv - 6  # the block comes last
        self._grips = [model.body(named(index, arm.description.grasp_link)).id for index, arm in enumerate(scene.arms)]
        self._hands = [model.body(named(index, arm.description.joint(ARM_JOINTS[-1]).child)).id for index, arm in enumerate(scene.arms)]
        self._block = model.body(BLOCK_BODY).id
        self._target, self._feed, self._gain, self._fastest, self._effort = np.zeros((5, self._driven))
        self._push, self._wanted = np.zeros((2, model.nv))
        self._look = Look()
        self._drawing: _Drawing | None = None
        self._mirror: Engine | None = None
        self._window = _Window(scene) if gui else None

    @property
    def world(self) -> tuple[Any, Any]:
        """MuJoCo's model and data. Raises :class:`WorldClosed` after :meth:`close`."""
        if self._closed:
            raise WorldClosed()
        return self._model, self._data

    def reset(self) -> None:
        """The state of a world just made."""
        mujoco.mj_resetData(*self.world)
        self._target, self._feed, self._gain, self._fastest, self._effort = np.zeros((5, self._driven))
        self.time_s = 0.0
        if self._look.strips or self._look.bases:
            self._show(Look())
        self.fine(False)

    def fine(self, fine: bool) -> None:
        """Cut time finely, or coarsely."""
        self.world[0].opt.timestep = FINE_S if fine else COARSE_S

    def advance(self, seconds: float) -> None:
        """Let time pass, in whole steps."""
        (model, data), driven = self.world, self._driven
        step_s = model.opt.timestep
        rate, feed, fastest, effort, push, wanted = self._gain / step_s, self._feed, self._fastest, self._effort, self._push, self._wanted
        lowest_speed, lowest_effort = -fastest, -effort
        applied, angles, speeds, bias = data.qfrc_applied, data.qpos[:driven], data.qvel[:driven], data.qfrc_bias[:driven]
        for _ in range(steps := round(seconds / step_s)):
            mujoco.mj_step1(model, data)
            speed = np.minimum(np.maximum(rate * (self._target - angles) + feed, lowest_speed), fastest)
            wanted[:driven] = (speed - speeds) / step_s
            mujoco.mj_mulM(model, data, push, wanted)
            applied[:driven] = np.minimum(np.maximum(push[:driven] + bias, lowest_effort), effort)
            mujoco.mj_step2(model, data)
        self.time_s += steps * step_s
        if self._window is not None:
            self._window.show(data.qpos, self.time_s)

    def close(self) -> None:
        """Let model and data go; a second call does nothing."""
        self._closed = True
        self._model = self._data = self._drawing = None
        for other in (self._window, self._mirror):
            if other is not None:
                other.close()

    def joint(self, arm: int, name: str) -> int:
        """The number of the joint's degree of freedom."""
        return int(self.world[0].joint(named(arm, name)).dofadr[0])

    def set_joint(self, arm: int, joint: int, value: float) -> None:
        """Put a joint there at rest."""
        data = self.world[1]
        data.qpos[joint], data.qvel[joint] = value, 0.0

    def drive(self, arm: int, servo: Servo, position: float, velocity: float, gain: float) -> None:
        """A set-point of a servo."""
        joint = servo.joint
        self._target[joint], self._feed[joint], self._gain[joint] = position, velocity, gain
        self._fastest[joint], self._effort[joint] = servo.velocity, servo.effort

    def joint_values(self, arm: int, joints: Sequence[int]) -> list[float]:
        """Where joints are."""
        angles = self.world[1].qpos
        return [float(angles[joint]) for joint in joints]

    def grip_mm(self, arm: int) -> Floats:
        """Where an arm's grasp frame is (3,)."""
        mujoco.mj_kinematics(*self.world)
        return UNITS.to_mm(self._data.xpos[self._grips[arm]])

    def put_block(self, xyz_mm: Sequence[float], rpy_rad: Sequence[float]) -> None:
        """Put the block's frame there, at rest."""
        data, turned = self.world[1], np.zeros(4)
        mujoco.mju_mat2Quat(turned, transform(xyz_mm, rpy_rad)[:3, :3].ravel())
        data.qpos[-7:-4], data.qpos[-4:] = np.multiply(_MM, xyz_mm), turned
        data.qvel[-6:] = 0.0

    def block_transform(self) -> Floats:
        """T_world_block (4, 4) in mm."""
        place, turned, T = self.world[1].qpos[-7:], np.zeros(9), np.eye(4)
        mujoco.mju_quat2Mat(turned, place[3:])
        T[:3, :3], T[:3, 3] = turned.reshape(3, 3), place[:3] / _MM
        return T

    def touches(self, first: int, second: int, link: str | None = None) -> list[Touch]:
        """Where two bodies touched in the last step."""
        model, data = self.world
        found, force = [], np.zeros(6)
        for index, pair in enumerate(data.contact.geom.tolist()):
            owners = [self._owner[geom] for geom in pair]
            if owners == [second, first]:
                pair = pair[::-1]
            elif owners != [first, second]:
                continue
            names = [self._link[geom] for geom in pair]
            if link is None or names[0] == link:
                mujoco.mj_contactForce(model, data, index, force)
                found.append(Touch(names[0], names[1], float(data.contact.dist[index]) / _MM, float(force[0])))
        return found

    def bond(self, arm: int) -> None:
        """A rigid joint between an arm's hand and the block as they are now."""
        model, data = self.world
        mujoco.mj_kinematics(model, data)
        hand, block, T, back = self._hands[arm], self._block, np.zeros(3), np.zeros(4)
        mujoco.mju_negQuat(back, data.xquat[hand])
        mujoco.mju_rotVecQuat(T, data.xpos[block] - data.xpos[hand], back)
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, back, data.xquat[block])
        tie = model.eq(bond_name(arm))
        tie.data[:10] = [0.0, 0.0, 0.0, *T, *turned]
        data.eq_active[tie.id] = 1

    def release(self, arm: int) -> None:
        """Take the rigid joint away."""
        model, data = self.world
        data.eq_active[model.eq(bond_name(arm)).id] = 0

    def picture(self, camera: Camera, width: int, height: int) -> Pixels:
        """What ``camera`` sees now: drawn by OpenGL; by PyBullet, if that is there and OpenGL is not."""
        data = self.world[1]
        if gl_context() is None:
            return self._mirrored().picture(camera, width, height)
        if self._drawing is None or self._drawing.size != (width, height):
            self._drawing = None  # its memory first
            self._drawing = _Drawing(_compiled(self.scene, self._look), width, height)
        return self._drawing.picture(data.qpos, camera)

    def lay(self, one_mm: Floats, other_mm: Floats, height_mm: float, rgb: ArrayLike) -> None:
        """A flat strip between two edges."""
        colour = [float(value) for value in np.asarray(rgb)]
        self._show(self._look._replace(strips=[*self._look.strips, Strip(one_mm, other_mm, height_mm, colour)]))

    def paint_base(self, arm: int, rgb: ArrayLike) -> None:
        """Colour an arm's base and what turns on it."""
        self._show(self._look._replace(bases={**self._look.bases, arm: [float(value) for value in np.asarray(rgb)]}))

    def _show(self, look: Look) -> None:
        self._look, self._drawing = look, None

    def _mirrored(self) -> Engine:
        """A world of PyBullet in which everything is where it is here."""
        try:
            mirror: Engine = self._mirror or ENGINES["bullet"](self.scene)
        except MissingExtra as error:
            raise NoRenderer("MuJoCo") from error
        self._mirror = mirror
        mirror.reset()
        for index, arm in enumerate(self.scene.arms):
            for joint in arm.description.joints:
                if named(index, joint.name) in self._names:
                    (value,) = self.joint_values(index, [self.joint(index, joint.name)])
                    slides = joint.kind == "prismatic"
                    mirror.set_joint(index, mirror.joint(index, joint.name), mirror.units.length(value / _MM) if slides else value)
        T = self.block_transform()
        mirror.put_block(T[:3, 3].tolist(), rpy_of(T[:3, :3]))
        for strip in self._look.strips:
            mirror.lay(*strip)
        for index, rgb in self._look.bases.items():
            mirror.paint_base(index, rgb)
        return mirror

    def save(self) -> Any:
        """State, set-points, rigid joints."""
        model, data = self.world
        state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        return state, self.time_s, model.opt.timestep, model.eq_data.copy()

    def restore(self, state: Any) -> None:
        """Go back to what :meth:`save` gave."""
        model, data = self.world
        mujoco.mj_setState(model, data, state[0], mujoco.mjtState.mjSTATE_INTEGRATION)
        self.time_s, model.opt.timestep, model.eq_data[:] = state[1:]


class _Drawing:
    """Pictures of a model, of one size, with shadows and smooth edges."""

    def __init__(self, model: Any, width: int, height: int) -> None:
        self.size = (width, height)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._model, self._data = model, mujoco.MjData(model)
        self._scene, self._option = mujoco.MjvScene(model, _MOST_SHAPES), mujoco.MjvOption()
        gl_context().make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def picture(self, qpos: Floats, camera: Camera) -> Pixels:
        """RGB (height, width, 3)."""
        model, data, (width, height) = self._model, self._data, self.size
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(model, data, self._option, None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        for eye in self._scene.camera:
            _aim(eye, camera, width, height)
        pixels = np.zeros((height, width, 3), np.uint8)
        view = mujoco.MjrRect(0, 0, width, height)
        gl_context().make_current()
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, view, self._context)
        return np.ascontiguousarray(pixels[::-1])


def _aim(eye: Any, camera: Camera, width: int, height: int) -> None:
    """Make MuJoCo's camera that pinhole."""
    forward = np.subtract(camera.target_mm, camera.eye_mm)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    half_width, half_height = frustum_mm(camera, width, height)
    eye.pos, eye.forward, eye.up = np.multiply(_MM, camera.eye_mm), forward, np.cross(right / np.linalg.norm(right), forward)
    eye.frustum_center, eye.frustum_width = 0.0, half_width * _MM
    eye.frustum_bottom, eye.frustum_top = -half_height * _MM, half_height * _MM
    eye.frustum_near, eye.frustum_far = NEAR_MM * _MM, far_mm(camera) * _MM


class _Window:
    """MuJoCo's viewer, which shows one state after the other."""

    def __init__(self, scene: Scene) -> None:
        require_display("MuJoCo")
        import mujoco.viewer

        self._model = _compiled(scene, Look())
        self._data, self._shown_s = mujoco.MjData(self._model), 0.0
        try:
            self._viewer = mujoco.viewer.launch_passive(self._model, self._data, show_left_ui=False, show_right_ui=False)
        except Exception as error:  # what a display that is there does not do
            raise NoWindow("MuJoCo") from error
        eye = self._viewer.cam
        eye.lookat[:], eye.distance, eye.azimuth, eye.elevation = (0.0, 0.0, 0.1), 1.0, 0.0, -45.0

    def show(self, qpos: Floats, time_s: float) -> None:
        """Draw anew if it is time to."""
        if abs(time_s - self._shown_s) >= _FRAME_S and self._viewer.is_running():
            self._shown_s, self._data.qpos[:] = time_s, qpos
            mujoco.mj_forward(self._model, self._data)
            self._viewer.sync()

    def close(self) -> None:
        """Close it."""
        self._viewer.close()


@cache
def gl_context() -> Any:
    """What OpenGL draws in without a display: EGL or OSMesa on Linux, or what ``MUJOCO_GL`` names. None where there is none."""
    usual = {"linux": next((name for name, library in _LIBRARIES.items() if find_library(library)), ""), "darwin": "cgl"}
    name = os.environ.get("MUJOCO_GL") or usual.get(sys.platform, "glfw")
    try:
        context = importlib.import_module(f"mujoco.{name}").GLContext(64, 64)
        atexit.register(context.free)  # while its library is still there
        return context
    except Exception:  # a library that is there and does not work fails in many ways
        return None


def _compiled(scene: Scene, look: Look | None) -> Any:
    """The scene as MuJoCo's model. Raises :class:`UrdfError` for an arm that MuJoCo cannot take."""
    try:
        return mujoco.MjModel.from_xml_string(mjcf(scene, look))
    except ValueError as error:
        paths = ", ".join(dict.fromkeys(str(arm.description.path) for arm in scene.arms))
        raise UrdfError(paths, f"MuJoCo cannot take it: {first_line(error)}") from error


def _owners(model: Any) -> tuple[list[int], list[str]]:
    """Of each shape: whose it is, and the name of its link."""
    owners, links = [], []
    for body in model.geom_bodyid:
        name = model.body(body).name
        arm, _, link = name.partition("/")
        owners.append(int(arm) if link else {WORLD_BODY: TABLE, BLOCK_BODY: BLOCK}[name])
        links.append(link)
    return owners, links
