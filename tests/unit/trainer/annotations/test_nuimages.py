"""nuImages: masks unpacked exactly, painted in the devkit's order."""

import base64
import contextlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from l3ps.errors import AnnotationError
from l3ps_trainer.annotations import open_annotations
from l3ps_trainer.annotations.rle import BadMask, decode, decode_base64

from .conftest import HEIGHT, WIDTH, mask_column, packed, rows

SHAPES = arrays.array_shapes(min_dims=2, max_dims=2, max_side=40)


@settings(max_examples=200, deadline=None)
@given(arrays.arrays(np.bool_, SHAPES))
def test_any_mask_is_what_the_plain_encoder_packed(mask):
    assert np.array_equal(decode(packed(mask), mask.shape), mask)


@pytest.mark.parametrize("lengths", [(1440000,), (0, 1440000), (700_000, 40_000, 700_000), (0, 1, 1439999), (1, 2) * 3])
def test_long_runs(lengths):
    """Runs of the size of a camera image, which no small mask has."""
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    size = (900, 1600) if flat.size == 1_440_000 else (3, flat.size // 3)
    mask = flat.reshape(size[::-1]).T
    assert np.array_equal(decode(packed(mask), size), mask)


def test_a_mask_packed_by_hand():
    """Four pixels without, one with, four without."""
    mask = np.zeros((3, 3), bool)
    mask[1, 1] = True
    assert np.array_equal(decode(b"414", (3, 3)), mask)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=30), st.integers(0, 12), st.integers(0, 12))
def test_no_bytes_do_more_than_be_refused(noise, height, width):
    with contextlib.suppress(BadMask):
        assert decode(noise, (height, width)).shape == (height, width)


@pytest.mark.parametrize(
    ("text", "said"), [("é", "base64"), ("A", "base64"), ("", "empty"), ("////", "characters"), ("UFBQ", "cut short")]
)
def test_text_that_is_no_mask(text, said):
    with pytest.raises(BadMask, match=said):
        decode_base64(text, (3, 3))


def test_objects_over_surfaces_and_later_tokens_over_earlier(nuimages):
    found = open_annotations(nuimages)
    image = found.images[0].load()
    semantic = np.where(np.arange(WIDTH) < 4, 4, 11)[None].repeat(HEIGHT, 0)
    semantic[2:4, 2:6] = 7
    assert (image.semantic == semantic).all()
    assert (image.instance == np.select([semantic == 4, semantic == 7], [1, 2])).all()


def test_key_frames_without_annotation_are_told(nuimages):
    found = open_annotations(nuimages)
    assert [image.name for image in found.images] == ["samples/CAM_FRONT/0.png"]
    assert "1 key frame(s) have no annotation" in str(found.notes[0])


def test_categories_by_a_classes_file(nuimages, tmp_path):
    file = tmp_path / "classes.json"
    classes = [
        {"category": "vehicle.car", "name": "vehicle", "nuscenes": "car"},
        {"category": "human.pedestrian.adult", "name": "human", "nuscenes": "pedestrian"},
    ]
    file.write_text(json.dumps({"classes": classes, "void": ["flat.driveable_surface", "animal"]}))
    found = open_annotations(nuimages, classes=file)
    assert found.classes.names == ("void", "vehicle", "human") and found.counts()[0] > 0
    file.write_text(json.dumps({"classes": classes}))
    with pytest.raises(AnnotationError, match=r"no class is known for the category 'animal'"):
        open_annotations(nuimages, classes=file)


def _table(folder, name):
    return folder / "v1.0-mini" / f"{name}.json"


BREAKS = {
    "no table": (lambda f: _table(f, "category").unlink(), "missing-table", "v1.0-mini/category.json"),
    "cut table": (lambda f: _table(f, "object_ann").write_text("[{"), "bad-table", "v1.0-mini/object_ann.json"),
    "no column": (
        lambda f: rows(_table(f, "sample_data"), lambda r: r[0].pop("filename")),
        "bad-table", "v1.0-mini/sample_data.json",
    ),
    "no picture's row": (
        lambda f: rows(_table(f, "sample_data"), lambda r: r[1:]),
        "missing-row", "v1.0-mini/sample_data.json",
    ),
    "no category's row": (
        lambda f: rows(_table(f, "category"), lambda r: r[1:]), "missing-row", "v1.0-mini/category.json",
    ),
    "unknown category": (
        lambda f: rows(_table(f, "category"), lambda r: r[1].update(name="gizmo")),
        "unknown-class", "v1.0-mini/category.json",
    ),
    "climbs": (
        lambda f: rows(_table(f, "sample_data"), lambda r: r[0].update(filename="../x.png")),
        "unsafe-path", "v1.0-mini/sample_data.json",
    ),
    "no image": (
        lambda f: (f / "samples/CAM_FRONT/0.png").unlink(), "bad-image", "samples/CAM_FRONT/0.png",
    ),
    "mask of another size": (
        lambda f: rows(_table(f, "object_ann"), lambda r: r[0].update(mask=mask_column(np.ones((9, 6))))),
        "bad-mask", "v1.0-mini/object_ann.json: o2",
    ),
    "mask too short": (
        lambda f: rows(_table(f, "object_ann"), lambda r: r[0]["mask"].update(counts=base64.b64encode(b"1").decode())),
        "bad-mask", "v1.0-mini/object_ann.json: o2",
    ),
    "no mask": (
        lambda f: rows(_table(f, "object_ann"), lambda r: r[0].update(mask="x")),
        "bad-mask", "v1.0-mini/object_ann.json: o2",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "code", "where"), BREAKS.values(), ids=BREAKS)
def test_what_is_broken_is_named(nuimages, spoil, code, where):
    spoil(nuimages)
    with pytest.raises(AnnotationError) as caught:
        open_annotations(nuimages, format="nuimages")
    assert (code, where) in [(p.code, p.where) for p in caught.value.problems]
    assert len(caught.value.problems) <= 2


def test_two_versions_are_one_too_many_until_one_is_named(nuimages):
    import shutil

    shutil.copytree(nuimages / "v1.0-mini", nuimages / "v1.0-val")
    with pytest.raises(AnnotationError, match="several sets of tables"):
        open_annotations(nuimages)
    assert len(open_annotations(nuimages / "v1.0-val").images) == 1
