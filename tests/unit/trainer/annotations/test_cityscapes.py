"""Cityscapes' folders, and what becomes of its ids."""

import json

import numpy as np
import pytest

from l3ps.errors import AnnotationError
from l3ps_trainer.annotations import open_annotations

from .conftest import halves, rgb, save

STEM = "train/ulm/ulm_000000_000010"


def faults(path, **options):
    with pytest.raises(AnnotationError) as caught:
        open_annotations(path, format="cityscapes", **options)
    return [(p.code, p.where) for p in caught.value.problems]


def test_nineteen_classes_and_the_objects_ids(cityscapes):
    found = open_annotations(cityscapes)
    assert [image.name for image in found.images] == ["train/bochum/bochum_000000_000011", STEM]
    assert len(found.classes) == 20 and found.classes.names[1] == "road"
    image = found.images[0].load()
    assert {found.classes.names[i] for i in np.unique(image.semantic)} == {"car", "road"}
    assert np.unique(image.instance).tolist() == [0, 26001]


def test_every_label_id_goes_where_cityscapes_or_nuscenes_says(cityscapes):
    ids = np.arange(34, dtype=np.uint8).reshape(2, 17)
    save(cityscapes / f"leftImg8bit/{STEM}_leftImg8bit.png", np.zeros((2, 17, 3), np.uint8))
    save(cityscapes / f"gtFine/{STEM}_gtFine_labelIds.png", ids)
    save(cityscapes / f"gtFine/{STEM}_gtFine_instanceIds.png", ids.astype(np.uint16))
    found = open_annotations(cityscapes)
    image = found.images[1].load()
    names = dict(zip(ids.ravel().tolist(), (found.classes.names[i] for i in image.semantic.ravel()), strict=True))
    assert [i for i, name in names.items() if name == "void"] == [*range(7), 9, 10, 14, 15, 16, 18, 29, 30]
    assert (names[8], names[19], names[23], names[25], names[33]) == (
        "sidewalk", "traffic light", "sky", "rider", "bicycle",
    )  # fmt: skip
    targets = dict(zip(found.classes.names, found.classes.to_nuscenes, strict=True))
    assert (targets["sky"], targets["rider"], targets["person"], targets["pole"]) == (0, 2, 7, 15)
    assert not image.instance.any()


def test_other_ids_by_a_classes_file(cityscapes, tmp_path):
    file = tmp_path / "classes.json"
    file.write_text(json.dumps({"classes": [{"id": 26, "name": "vehicle", "nuscenes": "car"}], "void": [7]}))
    assert open_annotations(cityscapes, classes=file).classes.names == ("void", "vehicle")


def test_only_the_training_split_of_a_whole_copy(cityscapes):
    for kind, ending, array in (
        ("leftImg8bit", "leftImg8bit", rgb()),
        ("gtFine", "gtFine_labelIds", halves(26, 7)),
        ("gtFine", "gtFine_instanceIds", halves(26001, 7, np.uint16)),
    ):
        save(cityscapes / kind / "val" / "bonn" / f"bonn_000000_000001_{ending}.png", array)
    found = open_annotations(cityscapes)
    assert len(found.images) == 2 and "not val" in str(found.notes[0])
    assert [image.name for image in open_annotations(cityscapes / "leftImg8bit" / "val").images] == [
        "bonn/bonn_000000_000001"
    ]


BREAKS = {
    "no labels": (
        lambda f: (f / f"gtFine/{STEM}_gtFine_labelIds.png").unlink(),
        [("missing-counterpart", f"leftImg8bit/{STEM}_leftImg8bit.png"),
         ("missing-counterpart", f"gtFine/{STEM}_gtFine_instanceIds.png")],
    ),
    "no image": (
        lambda f: (f / f"leftImg8bit/{STEM}_leftImg8bit.png").unlink(),
        [("missing-counterpart", f"gtFine/{STEM}_gtFine_labelIds.png")],
    ),
    "no objects": (
        lambda f: (f / f"gtFine/{STEM}_gtFine_instanceIds.png").unlink(),
        [("missing-counterpart", f"gtFine/{STEM}_gtFine_labelIds.png")],
    ),
    "training ids": (
        lambda f: save(f / f"gtFine/{STEM}_gtFine_labelIds.png", halves(40, 7)),
        [("unknown-class", f"gtFine/{STEM}_gtFine_labelIds.png")],
    ),
    "objects of another class": (
        lambda f: save(f / f"gtFine/{STEM}_gtFine_instanceIds.png", halves(24001, 7, np.uint16)),
        [("bad-instances", f"gtFine/{STEM}_gtFine_instanceIds.png")],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "told"), BREAKS.values(), ids=BREAKS)
def test_what_is_broken_is_named(cityscapes, spoil, told):
    spoil(cityscapes)
    assert faults(cityscapes) == told


def test_without_any_object_file_there_are_no_objects(cityscapes):
    for path in cityscapes.rglob("*_instanceIds.png"):
        path.unlink()
    assert not open_annotations(cityscapes).has_instances
