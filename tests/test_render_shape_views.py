"""Shapes coloured by a number a vertex."""

import numpy as np

from render.shape_views import VIEWS, shape_views, value_colours


def test_colours_get_lighter_with_the_value_and_stop_at_the_limits():
    colours = value_colours(np.linspace(-1.0, 2.0, 31), 0.0, 1.0).astype(int)
    lightness = colours @ np.array([0.30, 0.59, 0.11])
    assert (np.diff(lightness[10:21]) > 0).all()
    np.testing.assert_array_equal(colours[:10], np.tile(colours[10], (10, 1)))
    np.testing.assert_array_equal(colours[21:], np.tile(colours[20], (10, 1)))
    assert colours[0, 2] > colours[0, 0], "low is blue"
    assert colours[-1, 2] < colours[-1, 0], "high is yellow"


def test_front_and_back_show_their_own_colours():
    corners = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (0.0, 1.6) for z in (-0.2, 0.2)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
         [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    front = (corners[:, 2] > 0).astype(float)
    picture = shape_views(corners, faces, [("value", front, 0.0, 1.0)], tile=(120, 200))
    assert picture.shape == (200, 120 * len(VIEWS), 3)
    middle = [picture[100, 120 * k + 60].astype(int) for k in range(len(VIEWS))]
    assert middle[0][0] > middle[0][2], f"the front is yellow: {middle[0]}"
    assert middle[2][2] > middle[2][0], f"the back is blue: {middle[2]}"
