"""Arms of other sizes in the canonical form, written as URDFs from a few lengths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from marl_handover.config import CellConfig

PARKED_DEG = [0.0, 140.0, -115.0, 70.0, 0.0]
"""Where the AL5A parks."""

LINKS = ("base_link", "turret", "upper_arm", "forearm", "wrist", "hand")
JOINTS = ("base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll")


@dataclass(frozen=True)
class ArmLengths:
    """Lengths in mm and limits in degrees of an arm whose links lie along +x at zero; its cell's hands are at ``pitch_deg``.

    ``shoulder`` is (forward, up) from the foot of the yaw axis; ``lateral`` how far to the left of its plane the grip is; ``hand``:
    fingers or none.
    """

    name: str
    shoulder: tuple[float, float]
    upper: float
    fore: float
    tool: float
    limits: dict[str, tuple[float, float]]
    pitch_deg: float = 0.0
    lateral: float = 0.0
    thick: float = 18.0
    effort: float = 5.0
    distance: float = 400.0
    hand: str = "fingers"

    def write(self, folder: Path) -> Path:
        """The arm as a URDF in ``folder``."""
        path = folder / f"{self.name}.urdf"
        path.write_text(self.urdf(), encoding="utf-8")
        return path

    def cell(self, folder: Path, **changes: object) -> CellConfig:
        """Two of it, facing each other, as far apart as :attr:`distance`."""
        at = {"pitch_deg": self.pitch_deg} if self.pitch_deg else {}
        return CellConfig(**{"name": self.name, "robot": str(self.write(folder)), "base_distance_mm": self.distance, **at, **changes})

    def urdf(self) -> str:
        """The text of the file."""
        foot, t = self.shoulder[1] * 0.3, self.thick
        links = [
            _link("base_link", 0.3, _cylinder(0, 0, foot / 2, 30.0, foot)),
            _link("turret", 0.15, _box(self.shoulder[0] / 2, 0, (self.shoulder[1] - foot) / 2, 20, 24, 0.7 * (self.shoulder[1] - foot))),
            _link("upper_arm", 0.1, _box(self.upper / 2, 0, 0, self.upper - 1.2 * t, t, t)),
            _link("forearm", 0.1, _box(self.fore / 2, 0, 0, self.fore - 1.2 * t, t, t)),
            _link("wrist", 0.05, _box(0.15 * self.tool, 0, 0, 0.3 * self.tool, 18, 18)),
            _link("hand", 0.05, _box(0.42 * self.tool, 0, 0, 0.22 * self.tool, 40, 24)),
            _link("grip", 0.001),
        ]
        places = ((0, 0, foot), (self.shoulder[0], 0, self.shoulder[1] - foot), (self.upper, 0, 0), (self.fore, 0, 0), (0, 0, 0))
        joints = [self._joint(index, place) for index, place in enumerate(places)]
        for side, sign in (("left", 1), ("right", -1)) if self.hand == "fingers" else ():
            share = 0.8 + 8.0 / self.tool  # fingers end 8 mm beyond the grip
            links.append(_link(f"finger_{side}_link", 0.006, _box(0, 2.0 * sign, 0, 0.4 * self.tool, 4, 12)))
            joints.append(
                f'<joint name="finger_{side}" type="prismatic"><parent link="hand"/><child link="finger_{side}_link"/>'
                f'<origin xyz="{share * self.tool / 1e3} {self.lateral / 1e3} 0"/><axis xyz="0 {sign} 0"/>'
                '<limit lower="0" upper="0.016" effort="23" velocity="0.095"/></joint>'
            )
        grip = f'<origin xyz="{self.tool / 1e3} {self.lateral / 1e3} 0"/>'
        joints.append(f'<joint name="grasp" type="fixed"><parent link="hand"/><child link="grip"/>{grip}</joint>')
        return f'<robot name="{self.name}">' + "\n".join(links + joints) + "</robot>"

    def _joint(self, index: int, at_mm: tuple[float, float, float]) -> str:
        lower, upper = (math.radians(value) for value in self.limits[JOINTS[index]])
        axis = ("0 0 1", *3 * ("0 -1 0",), "1 0 0")[index]
        return (
            f'<joint name="{JOINTS[index]}" type="revolute"><parent link="{LINKS[index]}"/><child link="{LINKS[index + 1]}"/>'
            f'<origin xyz="{at_mm[0] / 1e3} {at_mm[1] / 1e3} {at_mm[2] / 1e3}"/><axis xyz="{axis}"/>'
            f'<limit lower="{lower}" upper="{upper}" effort="{self.effort}" velocity="3"/></joint>'
        )


def _box(x: float, y: float, z: float, a: float, b: float, c: float) -> str:
    size = f"{a / 1e3} {b / 1e3} {c / 1e3}"
    origin = f'<origin xyz="{x / 1e3} {y / 1e3} {z / 1e3}"/>'
    return f'<collision>{origin}<geometry><box size="{size}"/></geometry></collision>'


def _cylinder(x: float, y: float, z: float, radius: float, length: float) -> str:
    origin = f'<origin xyz="{x / 1e3} {y / 1e3} {z / 1e3}"/>'
    return f'<collision>{origin}<geometry><cylinder radius="{radius / 1e3}" length="{length / 1e3}"/></geometry></collision>'


def _link(name: str, mass_kg: float, shape: str = "") -> str:
    moments = " ".join(f'{axis}="{mass_kg * 1e-3 * (axis[1] == axis[2])}"' for axis in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return f'<link name="{name}"><inertial><mass value="{mass_kg}"/><inertia {moments}/></inertial>{shape}</link>'


SO101 = ArmLengths(
    "so101_like", (30.4, 119.0), 116.0, 135.0, 159.2,
    {"base_yaw": (-110, 110), "shoulder": (-24, 176), "elbow": (-170, 23), "wrist_pitch": (-97, 93), "wrist_roll": (-90, 90)},
    pitch_deg=-60.0, lateral=-6.6, distance=540.0,
)  # fmt: skip
"""Lengths of an SO-101 whose hand points 60 degrees down, its pads closing on a thin pin beside the roll axis."""

WX250 = ArmLengths(
    "wx250_like", (0.0, 110.4), 255.0, 250.0, 174.0,
    {"base_yaw": (-175, 175), "shoulder": (-20, 180), "elbow": (-170, 20), "wrist_pitch": (-123, 107), "wrist_roll": (-90, 90)},
    distance=1000.0, effort=20.0,
)  # fmt: skip
"""Lengths of a WidowX 250, level."""

MEDIUM = ArmLengths(
    "medium", (0.0, 93.0), 106.0, 100.0, 113.0,
    {"base_yaw": (-120, 120), "shoulder": (-34, 177), "elbow": (-160, 45), "wrist_pitch": (-120, 97), "wrist_roll": (-177, 177)},
    distance=420.0,
)  # fmt: skip
"""An arm half as far-reaching again as the AL5A, its shoulder over the yaw axis."""
