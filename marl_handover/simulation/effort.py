"""Whether the joints of an arm are strong enough to hold it up: what is too weak is named before anything falls."""

from __future__ import annotations

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.errors import UrdfError
from marl_handover.geometry.capsules import joints_before
from marl_handover.geometry.closed_form import ClosedFormArm, pitch_frames
from marl_handover.geometry.se3 import apply
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.simulation.arm_file import whole

RADII = 9
"""Distances in the ring at which an arm is looked at."""

_GRAVITY_MM_S2 = 9.81e3


def require_effort(model: CellModel, motion: MotionConfig, homes_rad: Floats) -> None:
    """Raise :class:`UrdfError` for a joint whose effort does not hold its arm, at rest, anywhere in its ring or where it parks."""
    checked: set[int] = set()
    for index, (arm, ring) in enumerate(zip(model.arms, model.cell.arms, strict=True)):
        if id(arm) in checked:
            continue
        checked.add(id(arm))
        for role, source in zip(ARM_JOINTS, arm.description.sources, strict=True):
            if source.joint is not None and arm.description.joint(role).effort <= 0:
                problem = f"joint {source.joint!r} has effort 0 in its <limit>, and moves nothing in physics; say how strong it is"
                raise UrdfError(arm.description.path, problem)
        height_mm, radii = model.cell.pick_heights_mm[index], np.linspace(ring.r_min_mm, ring.r_max_mm, RADII)
        places = np.array([[r, 0.0, z] for z in (height_mm, height_mm + motion.lift_mm) for r in radii])
        q = arm.ik(places).reshape(-1, 5)
        postures = np.concatenate([q[arm.within_limits(q)], homes_rad[index][None]])
        needed = np.abs(holding_n_m(arm, postures))
        for joint, role in enumerate(ARM_JOINTS[1:4]):
            worst, said = int(needed[:, joint].argmax()), arm.description.joint(role)
            if said.effort < needed[worst, joint]:
                name = arm.description.sources[joint + 1].joint or role
                away = float(np.hypot(*arm.grip_mm(postures[worst])[:2]))
                problem = f"joint {name!r} has effort {said.effort:.3g} N m in its <limit>, and needs"
                raise UrdfError(
                    arm.description.path,
                    f"{problem} {needed[worst, joint]:.3g} to hold the arm up with the hand {away:.0f} mm out; correct it or the masses",
                )


def holding_n_m(arm: ClosedFormArm, q: Floats) -> Floats:
    """Torques (n, 3) in N m with which shoulder, elbow and wrist pitch hold the arm up at joints ``q`` (n, 5)."""
    description = whole(arm.description)
    frames, levels = arm.link_transforms(q), joints_before(description)
    pivots, _, _, _ = pitch_frames(arm.planar, q)
    cos, sin = np.cos(q[:, 0]), np.sin(q[:, 0])
    torques = np.zeros((len(q), 3))
    for link in description.links:
        if link.inertial is None or levels[link.name] < 2:
            continue
        at = apply(frames[link.name], link.inertial.xyz_mm)
        forward = cos * at[..., 0] + sin * at[..., 1]
        carried = np.arange(3) <= levels[link.name] - 2
        torques += carried * link.inertial.mass_kg * (forward[:, None] - pivots)
    return 1e-6 * _GRAVITY_MM_S2 * torques
