"""The top camera is the pinhole it says it is."""

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.errors import InvalidSetting
from marl_handover.report.motion import grip_mm
from marl_handover.simulation.camera import TOP, view
from tests.canonical_arms import PARKED_DEG


def red_centre(image):
    pixels = image.astype(int)
    rows, columns = np.nonzero((pixels[..., 0] > 120) & (pixels[..., 1] < 80) & (pixels[..., 2] < 80))
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (40.0, -60.0, 0.0), (-70.0, 30.0, 2.0)])
def test_the_red_bar_is_where_a_pinhole_camera_sees_it(cell, pose):
    cell.reset(pose)
    x = pose[0] + 9 * np.cos(pose[2])
    y = pose[1] + 9 * np.sin(pose[2])
    depth = 700 - cell.model.cell.config.block.height_mm
    wanted = (640 - 917 * y / depth, 360 - 917 * x / depth)
    # The pin hides part of the bar, and the renderer rounds to pixels.
    np.testing.assert_allclose(red_centre(cell.camera_image()), wanted, atol=3)


def test_pictures_have_the_size_asked_for_and_repeat(cell):
    cell.reset((10.0, 20.0, 0.5))
    first, second = cell.camera_image(160, 90), cell.camera_image(160, 90)
    assert first.shape == (90, 160, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, second)
    with pytest.raises(InvalidSetting, match="width"):
        cell.camera_image(0, 90)


@pytest.mark.parametrize(("width", "height"), [(640, 360), (640, 240), (320, 360), (500, 500)])
def test_a_picture_of_another_shape_shows_all_and_more(cell, width, height):
    """The whole of 1280 x 720 is in it, as large as it fits, in the middle."""
    pose = (150.0, 200.0, 0.0)  # near a corner
    cell.reset(pose)
    scale = min(width / 1280, height / 720)
    depth = 700 - cell.model.cell.config.block.height_mm
    wanted = (width / 2 - scale * 917 * pose[1] / depth, height / 2 - scale * 917 * (pose[0] + 9) / depth)
    np.testing.assert_allclose(red_centre(cell.camera_image(width, height)), wanted, atol=3)


def require_in_picture(points_mm, camera):
    """Assert that points (n, 3) are in the picture; how far they are across and along it (n,), in mm."""
    away = points_mm - camera.eye_mm
    forward = np.subtract(camera.target_mm, camera.eye_mm)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right = right / np.linalg.norm(right)
    depth, across, along = away @ forward, away @ right, away @ np.cross(right, forward)
    assert np.abs(camera.focal_px * across / depth).max() < camera.width_px / 2
    assert np.abs(camera.focal_px * along / depth).max() < camera.height_px / 2
    return across, along


@pytest.mark.parametrize("where", ["top", "overview"])
@pytest.mark.parametrize("name", ["triangle", "line4", "ring6"])
def test_cameras_over_many_arms_show_all_of_them_and_what_they_reach(name, where):
    model = build_cell(cell_config(name))
    rows = np.argwhere(model.grid.masks.any(axis=0))
    places = np.column_stack([model.grid.x_mm[rows[:, 0]], model.grid.y_mm[rows[:, 1]], np.zeros(len(rows))])
    parked = np.stack([grip_mm(model, arm, np.radians(PARKED_DEG)) for arm in range(model.cell.num_arms)])
    camera = view(where, model.cell)
    require_in_picture(places, camera)
    require_in_picture(parked if where == "overview" else parked * (1, 1, 0), camera)


@pytest.mark.parametrize("name", ["paper", "al5a"])
def test_the_overview_shows_all_that_arms_reach_and_the_parked_hands(name):
    model = build_cell(cell_config(name))
    cell, camera = model.cell, view("overview", model.cell)
    assert view("top", cell) is TOP
    angle, radius = (grid.ravel() for grid in np.meshgrid(np.linspace(*cell.yaw_rad, 60), [cell.r_min_mm, cell.r_max_mm]))
    points = []
    for base in cell.bases:
        turned = base.facing_rad + angle
        points.append(np.stack([base.x_mm + radius * np.cos(turned), base.y_mm + radius * np.sin(turned), 0 * angle], -1))
    parked = np.radians(PARKED_DEG)
    points += [grip_mm(model, arm, parked)[None] for arm in range(cell.num_arms)]
    across, _ = require_in_picture(np.concatenate(points), camera)
    assert across[60:120].mean() < 0  # the left arm's outer edge is on the left
