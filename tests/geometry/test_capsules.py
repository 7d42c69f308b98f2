"""Clearances against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from marl_handover.geometry.capsules import (
    COVER_MM,
    MOST_CAPSULES,
    ONE_CAPSULE_MM,
    Capsule,
    covering_capsules,
    enclosing_capsule,
    ground_clearance_mm,
    segment_distance,
    self_clearance_mm,
)
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import describe, robot_config
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import Primitive

ARM = ClosedFormArm(describe(robot_config("al5a")))
LINKS = {link.name: link for link in ARM.description.links}
BODIES = [["base_link"], ["turret"], ["upper_arm"], ["forearm"], ["wrist"], ["hand", "finger_left_link", "finger_right_link"]]
Floats = NDArray[np.float64]

SHAPES = [
    Primitive("box", (40.0, 22.0, 16.0), (5.0, -3.0, 2.0), (0.3, -0.5, 1.0)),
    Primitive("box", (10.0, 30.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    Primitive("cylinder", (30.0, 24.0), (1.0, 2.0, 3.0), (0.4, 0.0, 0.2)),
    Primitive("cylinder", (5.0, 80.0), (0.0, 0.0, 9.0), (0.0, 1.2, 0.0)),
    Primitive("sphere", (12.0,), (3.0, 4.0, 5.0), (0.0, 0.0, 0.0)),
]


def surface(shape: Primitive, n: int = 4000) -> Floats:
    """Points (m, 3) on a shape's surface, in its link's frame, with the extreme ones (corners, rims) among them."""
    rng = np.random.default_rng(0)
    if shape.kind == "box":
        local = rng.uniform(-0.5, 0.5, (n, 3))
        local[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-0.5, 0.5], n)
        corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
        local = np.concatenate([local, corners]) * shape.size_mm
    elif shape.kind == "cylinder":
        around = np.linspace(0, 2 * np.pi, n)
        ends = rng.choice([-0.5, 0.5], n) * shape.size_mm[1]
        local = np.stack([shape.size_mm[0] * np.cos(around), shape.size_mm[0] * np.sin(around), ends], axis=-1)
    else:
        local = rng.normal(size=(10 * n, 3))
        local *= shape.size_mm[0] / np.linalg.norm(local, axis=-1, keepdims=True)
    T = transform(shape.xyz_mm, shape.rpy_rad)
    return np.asarray(local @ T[:3, :3].T + T[:3, 3])


def dense_distance(a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> float:
    """Smallest distance among points sampled along two segments, zoomed in twice."""
    s_range, t_range, best = (0.0, 1.0), (0.0, 1.0), np.inf
    for _ in range(5):
        s, t = np.linspace(*s_range, 81), np.linspace(*t_range, 81)
        between = (a0 + s[:, None] * (a1 - a0))[:, None] - (b0 + t[:, None] * (b1 - b0))[None]
        distance = np.linalg.norm(between, axis=-1)
        i, j = np.unravel_index(distance.argmin(), distance.shape)
        best = min(best, float(distance[i, j]))
        ds, dt = 8 * (s[1] - s[0]), 8 * (t[1] - t[0])
        s_range = (max(0.0, s[i] - ds), min(1.0, s[i] + ds))
        t_range = (max(0.0, t[j] - dt), min(1.0, t[j] + dt))
    return best


# A coarse lattice makes parallel, crossing, touching and point-like segments common.
coordinate = st.integers(-3, 3).map(float)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)


@given(a0=point, a1=point, b0=point, b1=point)
@settings(max_examples=200, deadline=None)
def test_segment_distance_equals_dense_sampling(a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> None:
    exact = float(segment_distance(a0, a1, b0, b1))
    sampled = dense_distance(a0, a1, b0, b1)
    assert exact <= sampled + 1e-9
    assert exact == pytest.approx(sampled, abs=2e-3)
    assert exact == pytest.approx(float(segment_distance(b1, b0, a0, a1)), abs=1e-9)


def test_segment_distance_is_batched() -> None:
    ends = np.random.default_rng(0).normal(size=(4, 7, 3, 3))
    batch = segment_distance(*ends)
    assert batch.shape == (7, 3)
    assert batch[5, 2] == segment_distance(*ends[:, 5, 2])


@pytest.mark.parametrize("shape", SHAPES)
def test_capsule_encloses_its_shape_closely(shape: Primitive) -> None:
    capsule = enclosing_capsule("link", shape)
    points = surface(shape)
    start, end = (np.broadcast_to(np.array(v), points.shape) for v in (capsule.start_mm, capsule.end_mm))
    distance = segment_distance(points, points, start, end)
    assert distance.max() <= capsule.radius_mm + 1e-9
    assert distance.max() >= capsule.radius_mm - 0.1


def outside_mm(capsules: tuple[Capsule, ...], points: Floats) -> Floats:
    """How far points (n, 3) are outside of all capsules; negative inside one."""
    gaps = []
    for capsule in capsules:
        start, end = (np.broadcast_to(np.array(v), points.shape) for v in (capsule.start_mm, capsule.end_mm))
        gaps.append(segment_distance(points, points, start, end) - capsule.radius_mm)
    return np.min(gaps, axis=0)


edge = st.floats(2.0, 150.0)
angle = st.floats(-3.0, 3.0)


@given(size=st.tuples(edge, edge, edge), turn=st.tuples(angle, angle, angle))
@settings(max_examples=60, deadline=None)
def test_a_box_is_covered_and_what_stands_out_is_bounded(size: tuple[float, float, float], turn: tuple[float, float, float]) -> None:
    shape = Primitive("box", size, (3.0, -4.0, 5.0), turn)
    capsules = covering_capsules("link", shape)
    assert len(capsules) <= MOST_CAPSULES
    assert outside_mm(capsules, surface(shape, 500)).max() <= 1e-9
    # The farthest points of a capsule from the box are in the directions of its faces.
    T = transform(shape.xyz_mm, shape.rpy_rad)
    ends = np.array([[capsule.start_mm, capsule.end_mm] for capsule in capsules]) - T[:3, 3]
    excess = (np.abs(ends @ T[:3, :3]).max(axis=(0, 1)) + capsules[0].radius_mm - np.array(size) / 2).max()
    if len(capsules) == 1:
        assert excess <= ONE_CAPSULE_MM["box"] + 1e-9
    elif max(size) <= 60.0:
        assert excess <= COVER_MM + 1e-9


@given(radius=st.floats(5.0, 100.0), length=st.floats(2.0, 200.0))
@settings(max_examples=40, deadline=None)
def test_a_cylinder_is_covered(radius: float, length: float) -> None:
    shape = Primitive("cylinder", (radius, length), (1.0, 2.0, 3.0), (0.4, 0.0, 0.2))
    assert outside_mm(covering_capsules("link", shape), surface(shape, 500)).max() <= 1e-9


def test_every_shape_of_the_shipped_arm_keeps_its_one_capsule() -> None:
    for link in ARM.description.links:
        for shape in link.collisions:
            assert covering_capsules(link.name, shape) == (enclosing_capsule(link.name, shape),)


def test_a_flat_plate_stays_flat() -> None:
    plate = Primitive("box", (100.0, 100.0, 10.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert enclosing_capsule("link", plate).radius_mm > 45.0
    capsules = covering_capsules("link", plate)
    assert len(capsules) < 6
    assert max(capsule.radius_mm for capsule in capsules) < 5.0 + COVER_MM


@pytest.mark.parametrize("shape", SHAPES)
def test_ground_clearance_of_a_shape_equals_its_lowest_sampled_point(shape: Primitive, monkeypatch: pytest.MonkeyPatch) -> None:
    links = tuple(link if link.name != "hand" else type(link)("hand", (shape,)) for link in ARM.description.links)
    bare = tuple(link if link.name in ("hand", "turret") else type(link)(link.name, ()) for link in links)
    arm = ClosedFormArm(type(ARM.description)(**{**vars(ARM.description), "links": bare}))
    q = np.random.default_rng(3).uniform(arm.lower_rad, arm.upper_rad, (20, 5))
    frames = arm.link_transforms(q)["hand"]
    heights = surface(shape) @ frames[:, 2, :3].T + frames[:, 2, 3]
    exact = ground_clearance_mm(arm, q)
    assert (exact <= heights.min(axis=0) + 1e-9).all()
    np.testing.assert_allclose(exact, heights.min(axis=0), atol=0.05)


def test_ground_clearance_of_the_arm_is_its_lowest_moving_link() -> None:
    q = np.random.default_rng(4).uniform(ARM.lower_rad, ARM.upper_rad, (3, 10, 5))
    frames = ARM.link_transforms(q)
    heights = [
        np.min(surface(shape) @ frames[name][..., 2, :3, None] + frames[name][..., 2, 3, None, None], axis=(-2, -1))
        for body in BODIES[2:]
        for name in body
        for shape in LINKS[name].collisions
    ]
    np.testing.assert_allclose(ground_clearance_mm(ARM, q), np.min(heights, axis=0), atol=1e-9)


def test_self_clearance_is_the_closest_pair_of_bodies_that_are_no_neighbours() -> None:
    """Against capsules listed by hand: each body against all but its neighbours."""
    q = np.random.default_rng(5).uniform(ARM.lower_rad, ARM.upper_rad, (12, 5))
    clearance = self_clearance_mm(ARM, q)
    frames = ARM.link_transforms(q)
    assert clearance.shape == (12,)
    for k in range(12):
        ends = []
        for number, body in enumerate(BODIES):
            for name in body:
                for shape in LINKS[name].collisions:
                    capsule = enclosing_capsule(name, shape)
                    T = frames[name][k]
                    start, end = (T[:3, :3] @ np.array(v) + T[:3, 3] for v in (capsule.start_mm, capsule.end_mm))
                    ends.append((number, start, end, capsule.radius_mm))
        pairs = [(a, b) for a in ends for b in ends if b[0] - a[0] > 1]
        nearest = min(dense_distance(a[1], a[2], b[1], b[2]) - a[3] - b[3] for a, b in pairs)
        assert clearance[k] == pytest.approx(nearest, abs=0.02)


def test_known_poses() -> None:
    stretched, folded = np.zeros(5), np.radians([0.0, 90.0, -167.0, -95.0, 0.0])
    assert self_clearance_mm(ARM, stretched) > 0
    assert self_clearance_mm(ARM, folded) < 0  # the hand is pressed into the turret
    assert ground_clearance_mm(ARM, stretched) == pytest.approx(67 - 13)
    assert ground_clearance_mm(ARM, np.radians([0.0, -14.0, -90.0, 0.0, 0.0])) < 0


def test_yaw_leaves_the_ground_clearance_alone() -> None:
    q = np.random.default_rng(6).uniform(ARM.lower_rad, ARM.upper_rad, (20, 5))
    turned = q + [0.7, 0, 0, 0, 0]
    np.testing.assert_allclose(ground_clearance_mm(ARM, q), ground_clearance_mm(ARM, turned), atol=1e-9)
