"""From pixels to objects."""

import numpy as np
import pytest
from PIL import Image

from l3ps.errors import DriveLogError
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.images import read_rgb
from l3ps.segment.panoptic import fuse
from l3ps.segment.session import Segmenter

CAR, ROAD, PEDESTRIAN, VEGETATION = 4, 11, 7, 16


def test_two_red_blobs_on_blue_are_two_cars_on_the_road(write_bundle):
    image = np.zeros((64, 128, 3), np.uint8)
    image[..., 2] = 255
    image[20:40, 10:40] = image[20:40, 70:110] = (255, 0, 0)
    panoptic = Segmenter(ModelBundle.load(write_bundle())).segment(image)
    assert panoptic.size == (128, 64)
    assert panoptic.semantic.shape == (32, 64)
    assert panoptic.semantic[15, 10] == CAR
    assert panoptic.semantic[0, 0] == ROAD
    left, right = panoptic.instance[15, 10], panoptic.instance[15, 45]
    assert left > 0
    assert right > 0
    assert left != right
    assert ((panoptic.instance > 0) == (panoptic.semantic == CAR)).all()


def test_the_boundary_head_parts_touching_objects_and_costs_no_pixels(write_bundle):
    graph = write_bundle.graph(boundary=True)
    info = write_bundle.description(output={"semantic": "logits", "boundary": "inside", "boundary_threshold": 0.3})
    image = np.zeros((32, 64, 3), np.uint8)
    image[...] = (255, 0, 128)  # one large car, inside everywhere …
    image[:, 32] = (255, 0, 0)  # … but on this line
    panoptic = Segmenter(ModelBundle.load(write_bundle(graph=graph, info=info))).segment(image)
    assert set(np.unique(panoptic.instance)) == {1, 2}, "the line itself went to a side"
    assert panoptic.instance[5, 5] != panoptic.instance[5, 60]


def test_small_segments_are_no_objects_and_take_the_nearest_label():
    semantic = np.full((40, 40), ROAD, np.uint8)
    semantic[5:8, 5:8] = PEDESTRIAN
    semantic[20:35, 20:35] = CAR
    panoptic = fuse(semantic, (40, 40), min_area=10 / 1600)
    assert (panoptic.semantic[5:8, 5:8] == ROAD).all()
    assert (panoptic.instance[20:35, 20:35] == 1).all()


def test_segments_of_different_classes_never_share_an_id():
    semantic = np.full((30, 30), VEGETATION, np.uint8)
    semantic[2:9, 2:9], semantic[12:20, 2:9], semantic[2:9, 12:25] = CAR, PEDESTRIAN, CAR
    panoptic = fuse(semantic, (30, 30))
    pairs = {(int(s), int(i)) for s, i in zip(panoptic.semantic.ravel(), panoptic.instance.ravel(), strict=True) if i}
    assert len(pairs) == 3 == len({i for _, i in pairs})


def test_an_image_of_dropped_segments_only_is_void():
    panoptic = fuse(np.full((4, 4), CAR, np.uint8), (4, 4), min_area=2.0)
    assert not panoptic.semantic.any()
    assert not panoptic.instance.any()


def test_grey_and_colour_files_are_read_and_broken_ones_named(tmp_path):
    Image.fromarray(np.full((3, 5), 7, np.uint8)).save(tmp_path / "grey.png")
    assert read_rgb(tmp_path / "grey.png").tolist() == np.full((3, 5, 3), 7).tolist()
    (tmp_path / "cut.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(DriveLogError, match=r"cut\.jpg.*decoded"):
        read_rgb(tmp_path / "cut.jpg")
    with pytest.raises(DriveLogError, match=r"gone\.jpg.*not there"):
        read_rgb(tmp_path / "gone.jpg")
