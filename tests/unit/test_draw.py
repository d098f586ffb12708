"""What a viewer may rely on in the bird's-eye pictures."""

import numpy as np
import pytest

from l3ps.draw import BACKGROUND, VOID, birdseye, class_view, difference_view, distinct_colors, instance_view
from l3ps.taxonomy import NUSCENES16, SEMANTICKITTI19

CAR, PEDESTRIAN, ROAD, TREE = 4, 7, 11, 16
ORIGIN = np.zeros((1, 3))


def classes(*values):
    return np.array(values, dtype=np.uint8)


def picture(points, view, **kwargs):
    """A map of 20 × 20 m on 400 × 400 pixels, the sensor at its centre."""
    options = {"sensors": ORIGIN, "title": "t", "radius": 10.0, "pixels": 400} | kwargs
    return birdseye(np.asarray(points, dtype=np.float32).reshape(-1, 3), view, **options)


def color_at(image, x, y):
    """The colour at a place in metres on the map of :func:`picture`."""
    return tuple(image[round(200 - 20 * y), round(200 + 20 * x)].tolist())


def test_x_points_right_and_y_up():
    semantic = classes(ROAD, TREE)
    image = picture([[5, 0, 0], [0, 5, 0]], class_view(semantic, NUSCENES16))
    assert color_at(image, 5, 0) == NUSCENES16.colors[ROAD]
    assert color_at(image, 0, 5) == NUSCENES16.colors[TREE]
    assert color_at(image, -5, 0) != color_at(image, 5, 0)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_higher_point_hides_the_lower_one(order):
    points, semantic = np.array([[5, 5, 0.0], [5, 5, 3.0]]), classes(ROAD, TREE)
    view = class_view(semantic[list(order)], NUSCENES16)
    assert color_at(picture(points[list(order)], view), 5, 5) == NUSCENES16.colors[TREE]


def test_a_car_shows_below_a_tree_and_void_below_all():
    points = [[5, 5, 0], [5, 5, 9], [-5, 5, 0], [-5, 5, 9]]
    image = picture(points, class_view(classes(CAR, TREE, ROAD, 0), NUSCENES16))
    assert color_at(image, 5, 5) == NUSCENES16.colors[CAR]
    assert color_at(image, -5, 5) == NUSCENES16.colors[ROAD]


def test_points_out_of_view_and_scans_without_points():
    nothing = picture(np.zeros((0, 3)), class_view(classes(), NUSCENES16))
    outside = picture([[50, 0, 0], [0, -11, 0]], class_view(classes(CAR, CAR), NUSCENES16))
    assert np.array_equal(nothing[:, :400], outside[:, :400])
    assert color_at(nothing, 3, 3) == BACKGROUND


def test_the_map_follows_the_sensors_path():
    image = picture([[30, 0, 0]], class_view(classes(CAR), NUSCENES16), sensors=np.array([[0, 0, 0], [25.0, 0, 0]]))
    height, width = image.shape[:2]
    car = np.argwhere((image[:, :400] == NUSCENES16.colors[CAR]).all(axis=2))
    assert width > 400 > height > 150
    # 45 m on 400 pixels, from -10 m on: the car at 30 m is at pixel 356
    assert car[:, 1].mean() == pytest.approx(356, abs=2)


def test_the_legend_lists_what_is_there_by_share_and_void_last():
    view = class_view(classes(*[0] * 5, *[TREE] * 3, *[CAR] * 2), NUSCENES16)
    assert [(e.label, e.note) for e in view.legend] == [("vegetation", "30.0 %"), ("car", "20.0 %"), ("void", "50.0 %")]
    assert view.legend[-1].color == VOID


def test_every_class_can_be_seen_on_the_background():
    for space in (NUSCENES16, SEMANTICKITTI19):
        colors = class_view(np.arange(1, len(space.classes), dtype=np.uint8), space).colors
        assert (colors @ np.array([0.299, 0.587, 0.114])).min() > 99


def test_an_object_keeps_its_color_in_every_picture():
    one = instance_view(classes(CAR, CAR, PEDESTRIAN, ROAD), np.array([7, 8, 7, 0]), NUSCENES16)
    other = instance_view(classes(ROAD, CAR, TREE, CAR), np.array([0, 8, 0, 7]), NUSCENES16)
    assert one.colors[0].tolist() == other.colors[3].tolist()
    assert one.colors[1].tolist() == other.colors[1].tolist()
    assert len({tuple(c) for c in one.colors.tolist()}) == 4
    assert [(e.label, e.note) for e in one.legend][:2] == [("car", "2"), ("pedestrian", "1")]


def test_neighbouring_ids_are_far_apart_in_color():
    colors = distinct_colors(np.full(40, CAR), np.arange(1, 41)).astype(int)
    assert np.abs(np.diff(colors, axis=0)).sum(axis=1).min() > 99
    assert len(np.unique(colors, axis=0)) == 40


def test_things_without_an_id_stand_out_and_stuff_is_gray():
    view = instance_view(classes(CAR, ROAD, 0), np.array([0, 5, 0]), NUSCENES16)
    assert view.colors[0].tolist() == [235, 235, 235]
    assert all(len(set(color)) == 1 for color in view.colors[1:].tolist())
    assert "thing without id" in [e.label for e in view.legend]


def test_the_difference_tells_four_cases_apart():
    view = difference_view(classes(CAR, CAR, CAR, CAR, 0), classes(CAR, CAR, ROAD, 0, CAR))
    assert {e.label: e.note for e in view.legend} == {
        "right": "50.0 %", "wrong class": "25.0 %", "not labelled": "25.0 %", "no truth": "",
    }  # fmt: skip
    assert len({tuple(c) for c in view.colors.tolist()}) == 4
    assert view.layer.tolist() == [1, 1, 2, 2, 0]


def test_a_long_legend_is_never_cut_off():
    view = class_view(np.arange(17, dtype=np.uint8), NUSCENES16)
    image = picture(np.zeros((17, 3)), view, pixels=200)
    assert len(image) >= 17 * 26
    assert (image[200:, 210:] != BACKGROUND).any()
