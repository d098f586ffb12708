"""COCO panoptic: colours to segments, categories to classes, crowds to void."""

import json

import numpy as np
import pytest

from l3ps.errors import AnnotationError
from l3ps_trainer.annotations import open_annotations

from .conftest import colours, halves, rgb, rows, save

TABLE = "annotations/panoptic_val2017.json"
MAP = "annotations/panoptic_val2017/1.png"


def faults(path, **options):
    with pytest.raises(AnnotationError) as caught:
        open_annotations(path, format="coco", **options)
    return [(p.code, p.where) for p in caught.value.problems]


def test_segments_of_things_are_objects(coco):
    image = open_annotations(coco).images[1].load()
    assert (image.rgb == rgb(1)).all()
    assert (image.semantic == halves(4, 11)).all()
    assert (image.instance == halves(3_226_956, 0)).all()


def test_a_crowd_and_what_has_no_segment_are_void(coco):
    rows(coco / TABLE, lambda c: c["annotations"][1]["segments_info"][0].update(iscrowd=1))
    ids = halves(3_226_956, 7)
    ids[0] = 0
    save(coco / MAP, colours(ids))
    image = open_annotations(coco).images[1].load()
    assert (image.semantic[1:] == halves(0, 11)[1:]).all() and not image.semantic[0].any()
    assert not image.instance.any()


def test_categories_by_the_names_of_coco_cityscapes_and_nuscenes(coco):
    names = {
        "tree-merged": 16,
        "traffic light": 15,
        "vehicle.bus.rigid": 3,
        "rider": 2,
        "sky-other-merged": 17,
        "dog": 0,
    }
    for name, index in names.items():
        rows(coco / TABLE, lambda c, name=name: c["categories"][1].update(name=name))
        assert set(np.unique(open_annotations(coco).images[0].load().semantic)) == {4, index}, name


def test_categories_by_a_classes_file_by_id_or_name(coco, tmp_path):
    rows(coco / TABLE, lambda c: c["categories"][1].update(name="gizmo"))
    assert faults(coco) == [("unknown-class", TABLE)]
    file = tmp_path / "classes.json"
    for entry in ({"id": 149, "name": "x", "nuscenes": "terrain"}, {"name": "gizmo", "nuscenes": 14}):
        file.write_text(json.dumps({"classes": [entry], "void": ["car"]}))
        found = open_annotations(coco, classes=file)
        assert found.classes.to_nuscenes == (0, 14)
        assert (found.images[0].load().semantic == halves(0, 1)).all()


def test_a_known_category_that_no_segment_has_need_not_be_known(coco):
    rows(coco / TABLE, lambda c: c["categories"].append({"id": 5, "name": "gizmo"}))
    assert len(open_annotations(coco).images) == 2


BREAKS = {
    "no JSON": (lambda f: (f / TABLE).write_text('{"segments_info"'), "bad-annotations", TABLE),
    "no list": (lambda f: rows(f / TABLE, lambda c: c.update(images=3)), "bad-annotations", TABLE),
    "no category": (lambda f: rows(f / TABLE, lambda c: c["categories"].pop()), "bad-annotations", TABLE),
    "image not listed": (lambda f: rows(f / TABLE, lambda c: c["images"].pop()), "bad-annotations", TABLE),
    "not annotated": (lambda f: rows(f / TABLE, lambda c: c["annotations"].pop()), "missing-counterpart", "1.png"),
    "twice": (
        lambda f: rows(f / TABLE, lambda c: c["annotations"].append(c["annotations"][0])),
        "bad-annotations", TABLE,
    ),
    "climbs": (
        lambda f: rows(f / TABLE, lambda c: c["images"][1].update(file_name="../x.png")),
        "bad-annotations", TABLE,
    ),
    "half a segment": (
        lambda f: rows(f / TABLE, lambda c: c["annotations"][1]["segments_info"][0].pop("id")),
        "bad-annotations", TABLE,
    ),
    "no map": (lambda f: (f / MAP).unlink(), "bad-labels", MAP),
    "no image": (lambda f: (f / "val2017/1.png").unlink(), "bad-image", "val2017/1.png"),
    "grey map": (lambda f: save(f / MAP, halves(1, 2)), "bad-labels", MAP),
    "other segments": (lambda f: save(f / MAP, colours(halves(3_226_956, 8))), "bad-labels", MAP),
    "a segment too many": (
        lambda f: rows(f / TABLE, lambda c: c["annotations"][1]["segments_info"].append({"id": 9, "category_id": 3})),
        "bad-labels", MAP,
    ),
    "size": (lambda f: save(f / MAP, colours(halves(3_226_956, 7)[1:])), "wrong-label-size", "val2017/1.png"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "code", "where"), BREAKS.values(), ids=BREAKS)
def test_what_is_broken_is_named(coco, spoil, code, where):
    spoil(coco)
    assert faults(coco) == [(code, where)]


def test_two_files_are_one_too_many(coco):
    (coco / "annotations" / "more.json").write_text((coco / TABLE).read_text())
    assert [code for code, _ in faults(coco)] == ["several-annotations"]
