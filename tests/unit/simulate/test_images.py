"""Simulated annotations: a folder of pictures and labels that belong together."""

import json

import cv2
import numpy as np
import pytest

from l3ps.errors import Cancelled, InputError
from l3ps.simulate import annotated_images, simulate_images, worth_annotating


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_the_files_hold_what_was_drawn(tmp_path):
    simulate_images(tmp_path / "set", count=2, seed=5, width=160)
    for i, (stem, drawn) in enumerate(
        zip(("0000_CAM_FRONT", "0001_CAM_FRONT_RIGHT"), annotated_images(2, 5, width=160), strict=True)
    ):
        assert (read(tmp_path / "set" / "images" / f"{stem}.png")[..., ::-1] == drawn.rgb).all(), i
        assert (read(tmp_path / "set" / "semantic" / f"{stem}.png") == drawn.semantic).all()
        instance = read(tmp_path / "set" / "instance" / f"{stem}.png")
        assert instance.dtype == np.uint16 and (instance == drawn.instance).all()
    classes = json.loads((tmp_path / "set" / "classes.json").read_text())
    assert classes["classes"][3] == {"id": 4, "name": "car", "nuscenes": "car"}
    assert classes["classes"][-1] == {"id": 17, "name": "sky", "nuscenes": "void"}
    assert classes["void"] == [0]


def test_chosen_pictures_keep_their_number(tmp_path):
    simulate_images(tmp_path / "few", count=2, seed=5, width=64, choose_from=4)
    chosen = worth_annotating([picture.semantic for picture in annotated_images(4, 5, width=64)], 2)
    assert [int(p.name[:4]) for p in sorted((tmp_path / "few" / "images").iterdir())] == chosen


def test_the_pictures_chosen_show_what_is_scarce():
    pictures = [np.full((8, 8), label, np.uint8) for label in [11] * 9 + [6]]
    assert worth_annotating(pictures, 2) == [0, 9]
    assert worth_annotating(pictures[:1], 5) == [0]


def test_all_problems_are_told_at_once(tmp_path):
    (tmp_path / "there").write_text("")
    with pytest.raises(InputError) as caught:
        simulate_images(tmp_path, count=5, seed=-1, choose_from=3, width=100)
    assert [p.where for p in caught.value.problems] == ["seed", "choose-from", "width", str(tmp_path)]


def test_a_cancelled_set_leaves_nothing(tmp_path):
    def stop(stage, done, total):
        raise Cancelled("enough")

    with pytest.raises(Cancelled):
        simulate_images(tmp_path / "set", count=2, seed=1, progress=stop, width=64)
    assert list(tmp_path.iterdir()) == []
