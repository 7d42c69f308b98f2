"""The dressed cell: tints where arms reach, and physics that does not notice."""

import numpy as np

from marl_handover.simulation.film import dress


def at(image, x_mm, y_mm):
    """Colour of the table there, in a picture of the top camera."""
    row, column = 360 - 917 * x_mm / 700, 640 - 917 * y_mm / 700
    return image[round(row), round(column)].astype(int)


def test_tints_tell_what_each_arm_reaches(cell):
    cell.reset((-200.0, -150.0, 0.0))
    plain = cell.camera_image()
    dress(cell)
    image = cell.camera_image()
    left, right, both, none = ((150, 90), (150, -90), (0, 10), (260, 0))
    assert np.array_equal(at(image, *none), at(plain, *none))
    assert len({tuple(at(image, *place)) for place in (left, right, both, none)}) == 4
    reach = cell.model.cell.reaches(np.array([left, right, both, none], float))
    assert reach.tolist() == [[True, False], [False, True], [True, True], [False, False]]
    tint = {place: at(image, *place) - at(plain, *place) for place in (left, right, both)}
    assert tint[left][2] > tint[left][0]  # bluer
    assert tint[right][0] > tint[right][2]  # redder
    assert tint[both][0] > tint[both][2]  # yellow
    assert tint[both][1] > tint[both][2]


def test_physics_does_not_notice(cell, cycle):
    poses = []
    for dressed in (False, True):
        cell.reset((60.0, -10.0, 0.3))
        if dressed:
            dress(cell)
            cell.show_goal((0.0, 0.0, 0.0))
        cell.run(1, cycle(1, (60.0, -10.0), (-40.0, 5.0)))
        poses.append(cell.object_pose())
    assert np.array_equal(*poses)
