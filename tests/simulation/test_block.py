"""The block's mass properties against a sum over small pieces."""

import numpy as np
import pytest

from marl_handover.config import BlockConfig
from marl_handover.simulation.block import beads_mm, mass_properties


def test_mass_and_inertia_agree_with_a_sum_over_voxels():
    config = BlockConfig(side_mm=20, height_mm=8, pin_diameter_mm=6, pin_top_mm=20)
    axis, up = np.arange(-9.875, 10, 0.25), np.arange(0.125, 20, 0.25)
    x, y, z = np.meshgrid(axis, axis, up, indexing="ij")
    solid = (z < 8) | (np.hypot(x, y) < 3)
    x, y, z = x[solid], y[solid], z[solid]
    piece = 650e-9 * 0.25**3
    mass, centre, (across, _, along) = mass_properties(config)
    assert mass == pytest.approx(piece * len(x), rel=0.01)
    assert centre == pytest.approx(z.mean(), rel=0.01)
    assert across == pytest.approx(piece * (y**2 + (z - z.mean()) ** 2).sum(), rel=0.01)
    assert along == pytest.approx(piece * (x**2 + y**2).sum(), rel=0.01)


def test_the_beads_stay_within_the_pin():
    config = BlockConfig()
    beads = beads_mm(config)
    assert beads.min() - config.pin_diameter_mm / 2 == pytest.approx(config.height_mm)
    assert beads.max() + config.pin_diameter_mm / 2 == pytest.approx(config.pin_top_mm)
