"""Any format is recognised, from a folder, a folder around it or an archive."""

import shutil

import numpy as np
import pytest

from l3ps.errors import AnnotationError, DriveLogError
from l3ps.simulate import annotated_images, simulate_images
from l3ps_trainer.annotations import (
    NUSCENES_AND_SKY,
    Annotated,
    AnnotationSet,
    ClassSet,
    open_annotations,
    opened_annotations,
    spread,
)

from .conftest import halves, rgb, save

FORMATS = ("plain", "cityscapes", "coco", "nuimages")


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_recognised_and_means_the_same(request, name):
    folder = request.getfixturevalue(name)
    for given in ("auto", name):
        found = open_annotations(folder, format=given)
        image = found.images[0].load()
        to = np.array(found.classes.to_nuscenes)
        assert found.has_instances
        assert to[image.semantic[0]].tolist() == [4] * 4 + [11] * 5
        assert len(set(image.instance[0, :4])) == 1 and image.instance[0, 0] > 0 and not image.instance[0, 4:].any()
    others = [other for other in FORMATS if other != name]
    for other in others:
        with pytest.raises(AnnotationError, match="no annotated images found"):
            open_annotations(folder, format=other)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("kind", ["zip", "gztar"])
def test_an_archive_is_unpacked_and_removed(request, tmp_path, name, kind):
    folder = request.getfixturevalue(name)
    archive = shutil.make_archive(str(tmp_path / "packed"), kind, folder.parent, folder.name)
    from pathlib import Path

    scratch = tmp_path / "scratch"
    with opened_annotations(Path(archive), scratch) as found:
        assert found.images[0].load().rgb.shape == (6, 9, 3)
    assert list(scratch.iterdir()) == []


def test_an_archive_that_climbs_out_is_refused(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as archive:
        archive.writestr("../images/a.png", b"")
    with pytest.raises(DriveLogError, match="member's name"), opened_annotations(tmp_path / "bad.zip"):
        pass


@pytest.mark.parametrize(
    ("path", "said"), [("none", "no such file or folder"), ("file", "it is a file"), ("", "looked")]
)
def test_a_place_without_annotations(tmp_path, path, said):
    (tmp_path / "file").write_text("")
    with pytest.raises(AnnotationError, match=said):
        open_annotations(tmp_path / path)


def test_so_many_images_are_spread_over_all(plain):
    for name in "cdefgh":
        save(plain / "images" / f"{name}.png", rgb())
        save(plain / "semantic" / f"{name}.png", halves(4, 11))
        save(plain / "instance" / f"{name}.png", halves(1, 0))
    names = [[image.name for image in open_annotations(plain, images=k).images] for k in (1, 2, 8, 99)]
    assert names == [["e"], ["c", "g"], list("abcdefgh"), list("abcdefgh")]
    with pytest.raises(AnnotationError, match="0 images"):
        open_annotations(plain, images=0)


def test_only_the_images_taken_need_be_sound_inside(plain):
    save(plain / "semantic" / "a.png", halves(4, 99))
    assert [image.name for image in open_annotations(plain, images=1).images] == ["b"]


@pytest.mark.parametrize("count", range(1, 12))
@pytest.mark.parametrize("wanted", range(1, 12))
def test_a_spread_is_even_and_never_repeats(count, wanted):
    chosen = spread(count, wanted)
    assert len(chosen) == len(set(chosen)) == min(count, wanted)
    assert chosen == sorted(chosen) and chosen[0] >= 0 and chosen[-1] < count
    gaps = np.diff([-1, *chosen, count])
    assert gaps[1:-1].size == 0 or np.ptp(gaps[1:-1]) <= 1


def test_images_in_memory():
    found = AnnotationSet.of(NUSCENES_AND_SKY, [Annotated(rgb(), halves(4, 11), None)] * 2)
    assert found.counts()[11] == 60 and not found.has_instances
    assert [image.load().semantic[0, 0] for image in found.images] == [4, 4]
    assert len(found.subset([1]).images) == 1


def test_class_zero_is_void():
    for names, targets in ((("car",), (4,)), (("void", "a", "a"), (0, 1, 1)), (("void", "a"), (0,))):
        with pytest.raises(ValueError):
            ClassSet(names, targets)


def test_simulated_images_are_annotations(tmp_path):
    simulate_images(tmp_path / "set", count=2, seed=5, width=64)
    found = open_annotations(tmp_path / "set")
    assert found.classes == NUSCENES_AND_SKY and found.has_instances
    for image, drawn in zip(found.images, annotated_images(2, 5, width=64), strict=True):
        read = image.load()
        assert (read.rgb == drawn.rgb).all() and (read.semantic == drawn.semantic).all()
        assert (read.instance == drawn.instance).all()
