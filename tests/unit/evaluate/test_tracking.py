"""How well ids follow the true objects."""

import numpy as np
import pytest

from l3ps.drivelog.types import Truth
from l3ps.evaluate.tracking import IdConsistency, id_consistency
from l3ps.labels.types import ScanLabels

CAR, PEDESTRIAN, ROAD = 4, 7, 11


def scans(*predicted, size=20, objects=2):
    """Truth of two cars of 20 points a scan, and predictions that name each as given."""
    truth = Truth(np.full(size * objects, CAR, np.uint8), np.repeat(np.arange(1, objects + 1), size).astype(np.int32))
    labels = [
        ScanLabels("", np.full(size * objects, CAR, np.uint8), np.repeat(np.array(ids, np.int32), size))
        for ids in predicted
    ]
    return [truth] * len(predicted), labels


def test_objects_that_keep_their_ids():
    found = id_consistency(*scans(*[(7, 9)] * 5))
    assert found == IdConsistency(objects=2, followed=2, kept=2, exclusive=2, scans=10, matched=10)
    assert found.as_dict()["one_id"] == 100


def test_one_other_id_in_one_scan_loses_the_object():
    found = id_consistency(*scans((7, 9), (7, 9), (8, 9), (7, 9), (7, 9)))
    assert (found.kept, found.exclusive) == (1, 1)
    assert found.as_dict()["one_id"] == 50


def test_a_scan_without_a_match_loses_no_id_but_shows_in_the_scans_matched():
    found = id_consistency(*scans((7, 9), (0, 9), (7, 9), (7, 9), (7, 9)))
    assert (found.kept, found.matched, found.scans) == (2, 9, 10)


def test_an_object_that_is_never_found_is_not_followed_but_counts_among_all():
    figures = id_consistency(*scans(*[(7, 0)] * 5)).as_dict()
    assert (figures["one_id"], figures["one_id_of_all"], figures["scans_matched"]) == (100, 50, 50)


def test_an_id_that_goes_from_one_object_to_another_is_not_exclusive():
    found = id_consistency(*scans((7, 9), (7, 9), (7, 7 + 100), (7, 9), (9, 7)))
    assert found.kept == 0
    shared = id_consistency(*scans((7, 0), (7, 0), (7, 0), (0, 7), (0, 7)))
    assert (shared.followed, shared.kept, shared.exclusive) == (2, 2, 0)


def test_the_class_does_not_matter_for_an_id():
    truth, labels = scans(*[(7, 9)] * 5)
    labels[2].semantic[:] = PEDESTRIAN
    assert id_consistency(truth, labels).kept == 2


def test_two_objects_run_together_match_at_most_one():
    found = id_consistency(*scans(*[(7, 7)] * 5))
    assert (found.matched, found.followed) == (0, 0), "an intersection over union of a half is none"


def test_small_objects_and_those_seen_seldom_are_left_out():
    assert id_consistency(*scans(*[(7, 9)] * 5, size=14)).objects == 0
    assert id_consistency(*scans(*[(7, 9)] * 4)).objects == 0
    assert id_consistency(*scans(*[(7, 9)] * 4), min_scans=4).objects == 2


def test_points_void_in_the_truth_and_stuff_are_no_objects_and_dilute_none():
    truth, labels = scans(*[(7, 9)] * 5)
    wider = [
        Truth(np.append(t.semantic, np.full(99, [0], np.uint8)), np.append(t.instance, np.zeros(99, np.int32)))
        for t in truth
    ]
    named = [
        ScanLabels("", np.append(s.semantic, np.full(99, CAR, np.uint8)), np.append(s.instance, np.full(99, 7)))
        for s in labels
    ]
    assert id_consistency(wider, named) == id_consistency(truth, labels)
    road = [Truth(np.full(40, ROAD, np.uint8), np.zeros(40, np.int32))] * 5
    assert id_consistency(road, labels).objects == 0


def test_figures_of_scenes_add_up():
    one, other = id_consistency(*scans(*[(7, 9)] * 5)), id_consistency(*scans((7, 9), (8, 9), (7, 9), (7, 9), (7, 9)))
    assert (one + other).as_dict()["one_id"] == 75
    assert IdConsistency().as_dict()["one_id"] is None


def test_truth_and_labels_of_different_scans_are_refused():
    truth, labels = scans(*[(7, 9)] * 5)
    with pytest.raises(ValueError, match="5 scans with truth and 4 with labels"):
        id_consistency(truth, labels[:4])
    with pytest.raises(ValueError, match="points"):
        id_consistency(truth, scans(*[(7, 9)] * 5, size=19)[1])
