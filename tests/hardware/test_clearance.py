"""The gate's compiled geometry against the cell's, with wrist roll."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.geometry.capsules import capsule_pairs, segment_distance, self_clearance_mm
from marl_handover.geometry.se3 import transform
from marl_handover.hardware.clearance import alone_mm, arm_shapes, between_mm


@pytest.fixture(scope="module")
def postures(model):
    return np.random.default_rng(0).uniform(model.arm.lower_rad, model.arm.upper_rad, (60, 5))


def placed(model, q, base):
    """End points (K, 2, 3) in the world and radii (K,), the slow way."""
    frames, T = model.arm.link_transforms(q), transform((base[0], base[1], 0.0), (0.0, 0.0, base[2]))
    capsules = capsule_pairs(model.arm.description)[0]
    ends = [[(T @ frames[c.link] @ np.append(end, 1.0))[:3] for end in (c.start_mm, c.end_mm)] for c in capsules]
    return np.array(ends), np.array([c.radius_mm for c in capsules])


def test_alone(model, postures):
    shapes, out = arm_shapes(model), np.empty(2)
    moving = shapes.capsules[:, 0] >= 2
    for q in postures:
        alone_mm(q[None], shapes, out)
        ends, radii = placed(model, q, (0.0, 0.0, 0.0))
        assert out[0] == pytest.approx((ends[:, :, 2].min(axis=1) - radii)[moving].min(), abs=1e-9)
        assert out[1] == pytest.approx(float(self_clearance_mm(model.arm, q)), abs=1e-9)


def test_over_samples_it_is_the_smallest(model, postures):
    shapes, out, one = arm_shapes(model), np.empty(2), np.empty(2)
    alone_mm(postures, shapes, out)
    singles = []
    for q in postures:
        alone_mm(q[None], shapes, one)
        singles.append(one.copy())
    np.testing.assert_allclose(out, np.min(singles, axis=0), atol=1e-9)


def test_between(model, postures):
    shapes = arm_shapes(model)
    bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
    for q, other in zip(postures, postures[::-1], strict=True):
        ends, radii = placed(model, q, bases[0])
        others, other_radii = placed(model, other, bases[1])
        gaps = segment_distance(ends[:, None, 0], ends[:, None, 1], others[None, :, 0], others[None, :, 1])
        expected = (gaps - radii[:, None] - other_radii).min()
        assert between_mm(q[None], other[None], True, shapes, bases[0], bases[1]) == pytest.approx(expected, abs=1e-9)
        assert between_mm(other[None], q[None], False, shapes, bases[1], bases[0]) == pytest.approx(expected, abs=1e-9)


def test_in_pairs_or_each_with_each(model, postures):
    shapes = arm_shapes(model)
    bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in model.cell.bases]
    Q, others = postures[:6], postures[6:12]
    gaps = np.array([[between_mm(q[None], other[None], True, shapes, *bases) for other in others] for q in Q])
    assert between_mm(Q, others, True, shapes, *bases) == pytest.approx(np.diag(gaps).min())
    assert between_mm(Q, others, False, shapes, *bases) == pytest.approx(gaps.min())
