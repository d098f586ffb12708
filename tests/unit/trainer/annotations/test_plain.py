"""A plain folder is read as it means, and every way of breaking it is told with the file's name."""

import json

import numpy as np
import pytest

from l3ps.errors import AnnotationError
from l3ps_trainer.annotations import NUSCENES_AND_SKY, open_annotations

from .conftest import halves, rgb, save


def faults(path, **options):
    with pytest.raises(AnnotationError) as caught:
        open_annotations(path, **options)
    return [(p.code, p.where) for p in caught.value.problems]


def test_images_classes_and_objects(plain):
    found = open_annotations(plain)
    assert [image.name for image in found.images] == ["a", "b"]
    assert found.classes == NUSCENES_AND_SKY and found.has_instances
    image = found.images[1].load()
    assert (image.rgb == rgb(1)).all() and image.rgb.dtype == np.uint8
    assert (image.semantic == halves(4, 11)).all() and image.semantic.dtype == np.uint8
    assert (image.instance == halves(300, 0)).all() and image.instance.dtype == np.int32


def test_classes_that_never_occur_are_named(plain):
    found = open_annotations(plain)
    assert found.counts()[[4, 11]].tolist() == [48, 60]
    assert set(found.missing()) == set(NUSCENES_AND_SKY.names[1:]) - {"car", "driveable_surface"}


def test_without_instances_there_are_none(plain):
    for path in (plain / "instance").iterdir():
        path.unlink()
    (plain / "instance").rmdir()
    found = open_annotations(plain)
    assert not found.has_instances and found.images[0].load().instance is None


def test_own_classes_merge_ids_and_leave_void_out(plain):
    classes = {
        "classes": [
            {"id": 11, "name": "auto", "nuscenes": "car"},
            {"id": 12, "name": "auto", "nuscenes": 4},
            {"id": 13, "name": "Tree"},
        ],
        "void": [4],
    }
    (plain / "classes.json").write_text(json.dumps(classes))
    save(plain / "semantic" / "b.png", halves(12, 13))
    found = open_annotations(plain)
    assert found.classes.names == ("void", "auto", "Tree") and found.classes.to_nuscenes == (0, 4, 16)
    assert (found.images[0].load().semantic == halves(0, 1)).all()
    assert (found.images[1].load().semantic == halves(1, 2)).all()


def test_the_option_comes_before_the_folders_own_classes(plain, tmp_path):
    (plain / "classes.json").write_text("{}")
    file = tmp_path / "mine.json"
    file.write_text('{"classes": [{"id": 4, "name": "car"}, {"id": 11, "name": "road"}]}')
    assert open_annotations(plain, classes=file).classes.to_nuscenes == (0, 4, 11)
    assert faults(plain) == [("bad-classes", str(plain / "classes.json"))]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[", "not valid JSON"),
        ("{}", "no list 'classes'"),
        ('{"classes": [{"id": 1}]}', "has no 'name'"),
        ('{"classes": [{"id": 1, "name": "void"}]}', "called void"),
        ('{"classes": [{"id": -1, "name": "car"}]}', "neither a number"),
        ('{"classes": [{"id": 1, "name": "gizmo"}]}', "no 'nuscenes' that is one of void, barrier"),
        ('{"classes": [{"id": 1, "name": "gizmo", "nuscenes": 17}]}', "no 'nuscenes'"),
        ('{"classes": [{"id": 1, "name": "car"}, {"id": 1, "name": "bus"}]}', "of another class"),
        ('{"classes": [{"id": 1, "name": "car"}, {"id": 2, "name": "car", "nuscenes": 3}]}', "the same name"),
        ('{"classes": [{"id": 1, "name": "car"}], "void": [1]}', "a class as well"),
        ('{"classes": [{"id": 1, "name": "car"}], "void": 3}', "no list"),
    ],
)
def test_a_classes_file_that_cannot_be_meant(plain, tmp_path, content, said):
    file = tmp_path / "mine.json"
    file.write_text(content)
    with pytest.raises(AnnotationError, match=said):
        open_annotations(plain, classes=file)


def test_a_classes_file_that_is_not_there(plain, tmp_path):
    assert faults(plain, classes=tmp_path / "none.json") == [("bad-classes", str(tmp_path / "none.json"))]


BREAKS = {
    "no labels": (lambda f: (f / "semantic" / "a.png").unlink(), "missing-counterpart", "images/a.png"),
    "no image": (lambda f: (f / "images" / "a.png").unlink(), "missing-counterpart", "semantic/a.png"),
    "no objects": (lambda f: (f / "instance" / "b.npy").unlink(), "missing-counterpart", "images/b.png"),
    "notes": (lambda f: (f / "images" / "notes.txt").write_text(""), "unexpected-file", "images/notes.txt"),
    "twice": (lambda f: save(f / "images" / "a.npy", rgb()), "unexpected-file", "images/a.png"),
    "cut": (lambda f: _cut(f / "images" / "a.png"), "bad-image", "images/a.png"),
    "cut labels": (lambda f: _cut(f / "semantic" / "b.png"), "bad-labels", "semantic/b.png"),
    "cut array": (lambda f: _cut(f / "instance" / "b.npy"), "bad-labels", "instance/b.npy"),
    "colours": (lambda f: save(f / "semantic" / "a.png", rgb()), "bad-labels", "semantic/a.png"),
    "fractions": (lambda f: save(f / "instance" / "a.npy", np.zeros((6, 9))), "bad-labels", "instance/a.npy"),
    "size": (lambda f: save(f / "semantic" / "a.png", halves(4, 11)[1:]), "wrong-label-size", "images/a.png"),
    "object size": (lambda f: save(f / "instance" / "a.npy", halves(1, 0)[1:]), "wrong-label-size", "images/a.png"),
    "unknown id": (lambda f: save(f / "semantic" / "a.png", halves(4, 99)), "unknown-class", "semantic/a.png"),
    "negative": (lambda f: save(f / "instance" / "a.npy", halves(-1, 0)), "bad-instances", "instance/a.npy"),
    "huge": (lambda f: save(f / "instance" / "a.npy", halves(1 << 40, 0)), "bad-instances", "instance/a.npy"),
}


def _cut(path):
    path.write_bytes(path.read_bytes()[:-20])


@pytest.mark.parametrize(("spoil", "code", "where"), BREAKS.values(), ids=BREAKS)
def test_what_is_broken_is_named(plain, spoil, code, where):
    spoil(plain)
    assert faults(plain) == [(code, where)]


def test_all_void_is_nothing_to_learn_from(plain):
    for name in "ab":
        save(plain / "semantic" / f"{name}.png", halves(0, 0))
    assert faults(plain) == [("nothing-annotated", "plain")]


def test_every_fault_is_told_up_to_a_bound(plain):
    for i in range(50):
        save(plain / "images" / f"x{i:02d}.png", rgb())
    found = faults(plain)
    assert len(found) == 21 and found[-1] == ("more-faults", "plain")


def test_labels_that_vanish_after_the_check_are_a_sentence_too(plain):
    image = open_annotations(plain).images[0]
    (plain / "semantic" / "a.png").unlink()
    with pytest.raises(AnnotationError, match=r"semantic/a\.png: the file is not there"):
        image.load()


def test_arrays_palettes_and_grey_images(plain):
    from PIL import Image

    save(plain / "images" / "c.npy", rgb(2))
    palette = Image.fromarray(halves(4, 11, np.uint8))
    palette.putpalette([7] * 768)
    palette.save(plain / "semantic" / "c.png")
    save(plain / "instance" / "c.png", halves(40_000, 0, np.uint16))
    save(plain / "images" / "d.jpg", halves(90, 90))
    save(plain / "semantic" / "d.npy", halves(4, 11))
    save(plain / "instance" / "d.png", halves(1, 0))
    *_, c, d = (image.load() for image in open_annotations(plain).images)
    assert (c.rgb == rgb(2)).all() and (c.semantic == halves(4, 11)).all() and c.instance.max() == 40_000
    assert d.rgb.shape == (6, 9, 3) and (d.semantic == c.semantic).all()


def test_an_image_array_of_another_kind(plain):
    (plain / "images" / "a.png").unlink()
    save(plain / "images" / "a.npy", rgb().astype(np.float32))
    image = open_annotations(plain).images[0]
    with pytest.raises(AnnotationError, match=r"images/a\.npy: its array is float32"):
        image.load()
