"""What the figures mean, on scans small enough to count by hand."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l3ps.drivelog.types import Truth
from l3ps.evaluate import PanopticEvaluator

CAR, PEDESTRIAN, TRUCK, ROAD, TREE = 4, 7, 10, 11, 16


def scan(*runs):
    """(n, truth class, truth id, predicted class, predicted id) per run of points."""
    columns = [np.repeat([run[i] for run in runs], [run[0] for run in runs]) for i in range(1, 5)]
    t_sem, t_inst, p_sem, p_inst = columns
    return Truth(t_sem.astype(np.uint8), t_inst.astype(np.int32)), p_sem.astype(np.uint8), p_inst.astype(np.int32)


def evaluated(protocol, *runs):
    evaluator = PanopticEvaluator(protocol)
    evaluator.add(*scan(*runs))
    return evaluator.quality()


def test_figures_of_a_split_car_and_a_missed_tree():
    quality = evaluated(
        "nuscenes",
        (80, CAR, 1, CAR, 7),
        (20, CAR, 1, CAR, 8),  # the car's tail became another car
        (50, ROAD, 0, ROAD, 0),
        (30, TREE, 0, ROAD, 0),
    )
    car, road, tree = (quality.classes[name] for name in ("car", "driveable_surface", "vegetation"))
    assert (car.tp, car.fp, car.fn, car.iou) == (1, 1, 0, 100)
    assert (car.sq, car.rq, car.pq) == pytest.approx((80, 100 / 1.5, 80 / 1.5))
    assert (road.tp, road.fp, road.fn) == (1, 0, 0)
    assert (road.pq, road.iou) == pytest.approx((62.5, 62.5))
    assert (tree.tp, tree.fn, tree.pq, tree.iou) == (0, 1, 0, 0)
    assert quality.pq == pytest.approx((80 / 1.5 + 62.5 + 0) / 3)
    assert quality.pq_things == pytest.approx(80 / 1.5)
    assert quality.pq_stuff == pytest.approx(31.25)
    assert quality.miou == pytest.approx((100 + 62.5 + 0) / 3)
    assert quality.as_dict()["classes"]["car"]["fp"] == 1


def test_segments_below_the_minimum_are_no_error_but_a_match_counts():
    quality = evaluated(
        "nuscenes",
        (14, CAR, 1, CAR, 1),  # matched, whatever its size
        (14, CAR, 2, ROAD, 0),  # too small to be missed
        (14, ROAD, 0, CAR, 3),  # too small to be wrong
        (15, PEDESTRIAN, 1, CAR, 4),  # just large enough for both
    )
    car = quality.classes["car"]
    assert (car.tp, car.fp, car.fn) == (1, 1, 0)
    assert quality.classes["pedestrian"].fn == 1
    assert quality.classes["driveable_surface"].fn == 0


def test_iou_of_one_half_is_no_match():
    assert evaluated("nuscenes", (40, CAR, 1, CAR, 1), (40, CAR, 1, CAR, 2)).classes["car"].tp == 0
    assert evaluated("nuscenes", (41, CAR, 1, CAR, 1), (40, CAR, 1, CAR, 2)).classes["car"].tp == 1


def test_means_leave_out_classes_without_a_truth_segment_of_the_minimum_size():
    quality = evaluated("nuscenes", (50, ROAD, 0, ROAD, 0), (14, CAR, 1, ROAD, 0), (20, ROAD, 0, TRUCK, 1))
    assert quality.classes["truck"].fp == 1
    assert [name for name, c in quality.classes.items() if c.counted] == ["driveable_surface"]
    assert quality.pq == quality.classes["driveable_surface"].pq
    assert quality.pq_things is None


def test_a_class_whose_only_match_is_small_is_in_the_means():
    quality = evaluated("nuscenes", (50, ROAD, 0, TREE, 0), (14, CAR, 1, CAR, 1))
    assert (quality.classes["car"].truth_segments, quality.classes["car"].counted) == (0, True)
    assert (quality.pq, quality.pq_things) == (50, 100)


def test_void_in_the_truth_is_left_out():
    quality = evaluated("nuscenes", (50, CAR, 1, CAR, 1), (500, 0, 0, CAR, 1), (500, 0, 0, TRUCK, 2))
    assert (quality.classes["car"].pq, quality.classes["truck"].fp, quality.points) == (100, 0, 50)


def test_predicted_void_is_a_miss_except_under_the_papers_protocol():
    runs = [(60, CAR, 1, CAR, 1), (40, CAR, 1, 0, 0), (100, TREE, 0, 0, 0)]
    official, paper = evaluated("nuscenes", *runs), evaluated("paper", *runs)
    assert official.classes["car"].pq == pytest.approx(60)
    assert paper.classes["car"].pq == pytest.approx(100)
    assert official.classes["vegetation"].fn == 1
    assert paper.classes["vegetation"].fn == 0
    # A class that was left void altogether stays in the mean: abstaining must not choose the classes.
    assert paper.pq == pytest.approx(50)
    assert official.unlabelled == paper.unlabelled == pytest.approx(70)


def test_semantickitti_has_its_own_classes_and_minimum():
    quality = evaluated("semantickitti", (49, 1, 1, 9, 0), (50, 1, 2, 9, 0), (200, 19, 0, 19, 0))
    assert len(quality.classes) == 19
    assert quality.classes["car"].fn == 1
    assert quality.classes["traffic-sign"].pq == 100


def test_without_instances_in_the_truth_things_have_no_pq():
    truth, p_sem, p_inst = scan((60, CAR, 0, CAR, 1), (40, CAR, 0, CAR, 2), (50, ROAD, 0, ROAD, 0))
    evaluator = PanopticEvaluator("nuscenes")
    evaluator.add(Truth(truth.semantic, truth.instance, has_instances=False), p_sem, p_inst)
    quality = evaluator.quality()
    car = quality.classes["car"]
    assert (car.pq, car.sq, car.rq, car.tp, car.fp, car.fn) == (None,) * 6
    assert (quality.pq, quality.sq, quality.rq, quality.pq_things) == (None,) * 4
    assert quality.things_unscored == ("car",)
    assert (car.iou, quality.miou, quality.pq_stuff, quality.classes["driveable_surface"].pq) == (100, 100, 100, 100)


def test_truth_without_instances_but_without_things_either_is_scored():
    truth, p_sem, p_inst = scan((50, ROAD, 0, ROAD, 0), (50, TREE, 0, CAR, 1))
    evaluator = PanopticEvaluator("nuscenes")
    evaluator.add(Truth(truth.semantic, truth.instance, has_instances=False), p_sem, p_inst)
    assert evaluator.quality().pq == pytest.approx(50)
    assert evaluator.quality().classes["car"].fp == 1


@st.composite
def scans(draw):
    n = draw(st.integers(0, 300))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    blocks = np.sort(rng.integers(0, 6, n))
    truth = Truth(rng.integers(0, 17, 6)[blocks].astype(np.uint8), rng.integers(0, 4, 6)[blocks].astype(np.int32))
    p_sem = np.where(rng.random(n) < 0.2, rng.integers(0, 17, n), truth.semantic).astype(np.uint8)
    return truth, p_sem, rng.integers(0, 4, 6)[blocks].astype(np.int32)


@settings(max_examples=50, deadline=None)
@given(st.lists(scans(), max_size=5), st.integers(0, 5), st.sampled_from(["nuscenes", "paper"]))
def test_figures_add_up_over_any_split_and_survive_json(all_scans, cut, protocol):
    whole, first, second = (PanopticEvaluator(protocol) for _ in range(3))
    for s in all_scans:
        whole.add(*s)
    for s in all_scans[:cut]:
        first.add(*s)
    for s in all_scans[cut:]:
        second.add(*s)
    restored = PanopticEvaluator.from_state(json.loads(json.dumps(second.state())))
    restored.merge(first)
    a, b = whole.state(), restored.state()
    assert a.pop("iou_sum") == pytest.approx(b.pop("iou_sum"))
    assert a == b


@settings(max_examples=50, deadline=None)
@given(scans())
def test_the_names_of_instances_do_not_matter(one):
    truth, p_sem, p_inst = one
    plain, renamed = PanopticEvaluator("nuscenes"), PanopticEvaluator("nuscenes")
    plain.add(truth, p_sem, p_inst)
    names = np.array([2**31 - 1, 5, 2**24, 0], dtype=np.int32)
    renamed.add(Truth(truth.semantic, names[truth.instance]), p_sem, names[::-1][p_inst])
    a, b = plain.state(), renamed.state()
    assert a.pop("iou_sum") == pytest.approx(b.pop("iou_sum"))  # another order of summation
    assert a == b


def test_what_cannot_be_counted_is_refused():
    evaluator = PanopticEvaluator("nuscenes")
    truth, p_sem, p_inst = scan((20, CAR, 1, CAR, 1))
    with pytest.raises(ValueError, match="one length"):
        evaluator.add(truth, p_sem[:-1], p_inst[:-1])
    with pytest.raises(ValueError, match="label space"):
        evaluator.add(truth, p_sem + np.uint8(13), p_inst)
    with pytest.raises(ValueError, match="negative"):
        evaluator.add(truth, p_sem, p_inst - 2)
    with pytest.raises(ValueError, match="choose one of nuscenes, paper, semantickitti"):
        PanopticEvaluator("kitti")
    with pytest.raises(ValueError, match="cannot add"):
        evaluator.merge(PanopticEvaluator("paper"))
    with pytest.raises(ValueError, match="lacks 'tp'"):
        PanopticEvaluator.from_state({k: v for k, v in evaluator.state().items() if k != "tp"})
    assert evaluator.quality().scans == 0, "a refused scan must not be half counted"


def test_nothing_evaluated_has_no_figures():
    quality = PanopticEvaluator("nuscenes").quality()
    assert (quality.pq, quality.miou, quality.pq_things, quality.points) == (None, None, None, 0)
