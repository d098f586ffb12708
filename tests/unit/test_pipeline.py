"""The whole refinement on a scene small enough to reason about."""

from dataclasses import replace

import numpy as np
import pytest

from l3ps.drivelog.types import Points, Scan, Scene
from l3ps.errors import Cancelled, LabelError, ProcessingError
from l3ps.labels.types import Evidence, Provenance, ScanLabels
from l3ps.pipeline import REFINE_STAGES, refine_scene
from l3ps.presets import PRESETS

CAR, ROAD, MANMADE = 4, 11, 15


def street(rng, shift):
    """A ground plane, two walls and two cars, seen from a sensor that moves along x; and each point's true class."""
    ground = np.column_stack([rng.uniform(-30, 30, 6000), rng.uniform(-9, 9, 6000), rng.normal(-1.7, 0.01, 6000)])
    walls = np.column_stack([rng.uniform(-30, 30, 4000), rng.choice([-10, 10], 4000), rng.uniform(-1.7, 4, 4000)])
    pillars = np.column_stack(
        [rng.choice([-20, -8, 8, 20], 2000), rng.choice([-9, 9], 2000), rng.uniform(-1.7, 4, 2000)]
    )
    cars = [
        np.column_stack([rng.uniform(x, x + 4, 600), rng.uniform(y, y + 1.8, 600), rng.uniform(-1.4, -0.2, 600)])
        for x, y in ((8, 3), (14, -5))
    ]
    xyz = np.concatenate([ground, walls, pillars, *cars]).astype(np.float32)
    classes = np.repeat([ROAD, MANMADE, CAR], [6000, 6000, 1200]).astype(np.uint8)
    xyz[:, 0] -= shift
    xyz += np.random.default_rng(int(10 * shift)).normal(0, 0.01, xyz.shape).astype(np.float32)
    order = rng.permutation(len(xyz))
    return xyz[order], classes[order]


@pytest.fixture(scope="module")
def scene_and_truth():
    scans, truth = [], []
    for index in range(3):
        xyz, classes = street(np.random.default_rng(11), shift=0.5 * index)
        xyz[:7] = np.nan  # lost returns
        points = Points(xyz, np.full(len(xyz), 0.3, np.float32))
        scans.append(
            Scan(f"scan{index}", index, index * 100_000, None, np.eye(4), None, (), lambda points=points: points)
        )
        truth.append(classes)
    return Scene("street", tuple(scans)), truth


def noisy(scene, truth):
    """Primal labels in which one point in four is wrong and cars share ids."""
    rng = np.random.default_rng(5)
    labels = []
    for scan, classes in zip(scene.scans, truth, strict=True):
        semantic = np.where(rng.random(len(classes)) < 0.25, rng.choice([0, CAR, ROAD, MANMADE], len(classes)), classes)
        semantic[:7] = 0
        labels.append(
            ScanLabels(scan.token, semantic.astype(np.uint8), np.where(semantic == CAR, 1, 0).astype(np.int32))
        )
    return labels


@pytest.mark.parametrize("preset", PRESETS)
def test_refinement_repairs_labels_in_point_order_and_leaves_lost_returns_void(scene_and_truth, preset):
    scene, truth = scene_and_truth
    primal = noisy(scene, truth)
    seen = []
    refined = refine_scene(
        scene, primal, PRESETS[preset], sensor_height=1.7, progress=lambda stage, done, total: seen.append(stage)
    )
    for before, after, classes in zip(primal, refined.labels, truth, strict=True):
        assert after.token == before.token
        valid = slice(7, None)
        assert (after.semantic[valid] == classes[valid]).mean() > (
            before.semantic[valid] == classes[valid]
        ).mean() + 0.1
        assert not after.semantic[:7].any()
        assert ((after.instance > 0) <= (after.semantic == CAR)).all()
    assert list(dict.fromkeys(seen)) == list(REFINE_STAGES) == list(refined.costs)


def test_poses_follow_the_sensor(scene_and_truth):
    scene, truth = scene_and_truth
    poses = refine_scene(scene, noisy(scene, truth), PRESETS["paper"], sensor_height=1.7).poses
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]], atol=0.1)


def test_objects_from_geometry_have_an_id_each(scene_and_truth):
    scene, truth = scene_and_truth
    perfect = [
        ScanLabels(scan.token, np.where(np.arange(len(t)) < 7, 0, t).astype(np.uint8), np.zeros(len(t), np.int32))
        for scan, t in zip(scene.scans, truth, strict=True)
    ]
    labels = refine_scene(scene, perfect, PRESETS["best"], sensor_height=1.7).labels[0]
    xyz = scene.scans[0].load_points().xyz
    sides = [labels.instance[(labels.semantic == CAR) & (xyz[:, 1] * sign > 1)] for sign in (1, -1)]
    main = [np.bincount(ids[ids > 0]).argmax() for ids in sides]
    assert main[0] != main[1]
    assert all((ids == m).mean() > 0.95 for ids, m in zip(sides, main, strict=True))


def test_labels_of_another_log_are_refused(scene_and_truth):
    scene, truth = scene_and_truth
    primal = noisy(scene, truth)
    with pytest.raises(LabelError, match="name other scans"):
        refine_scene(scene, primal[::-1], PRESETS["paper"])
    short = ScanLabels(primal[0].token, primal[0].semantic[:-1], primal[0].instance[:-1])
    with pytest.raises(LabelError, match="13199 labels for 13200 points"):
        refine_scene(scene, [short, *primal[1:]], PRESETS["paper"])


def test_a_scan_without_points_in_range_is_named(scene_and_truth):
    scene, truth = scene_and_truth
    empty = Points(np.full((13200, 3), 0.1, np.float32), np.zeros(13200, np.float32))
    broken = Scan("scan1", 1, 1, None, np.eye(4), None, (), lambda: empty)
    with pytest.raises(ProcessingError, match="scan 1 has no point between 5 m and 80 m"):
        refine_scene(Scene("s", (scene.scans[0], broken)), noisy(scene, truth)[:2], PRESETS["paper"])


@pytest.mark.parametrize("stage", REFINE_STAGES)
def test_cancelling_stops_within_the_stage(scene_and_truth, stage):
    scene, truth = scene_and_truth

    def cancel(at, done, total):
        if at == stage:
            raise Cancelled

    with pytest.raises(Cancelled):
        refine_scene(scene, noisy(scene, truth), PRESETS["fast"], progress=cancel)


def test_two_runs_are_equal_and_a_stray_environment_variable_changes_nothing(scene_and_truth, monkeypatch):
    scene, truth = scene_and_truth
    first = refine_scene(scene, noisy(scene, truth), PRESETS["paper"])
    monkeypatch.setenv("kiss_icp_mapping", '{"voxel_size": 5.0}')
    second = refine_scene(scene, noisy(scene, truth), PRESETS["paper"])
    np.testing.assert_array_equal(second.poses, first.poses)
    for one, other in zip(first.labels, second.labels, strict=True):
        np.testing.assert_array_equal(one.semantic, other.semantic)
        np.testing.assert_array_equal(one.instance, other.instance)


def test_the_method_prints_nothing(scene_and_truth, capfd):
    scene, truth = scene_and_truth
    refine_scene(scene, noisy(scene, truth), PRESETS["fast"])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_point_says_how_sure_its_label_is_and_where_it_comes_from(scene_and_truth, preset):
    scene, truth = scene_and_truth
    refined = refine_scene(scene, noisy(scene, truth), PRESETS[preset], sensor_height=1.7)
    for labels, classes in zip(refined.labels, truth, strict=True):
        assert labels.confidence.dtype == labels.provenance.dtype == np.uint8
        void = labels.semantic == 0
        assert ((labels.provenance == Provenance.NONE) == void).all()
        assert ((labels.confidence == 0) >= void).all()
        assert (labels.confidence[~void] > 0).all()
        right = labels.semantic == classes
        assert labels.confidence[right].mean() > labels.confidence[~right & ~void].mean()
        assert {Provenance.CAMERA, Provenance.CLUSTER} & set(labels.provenance.tolist())


def test_ground_that_no_camera_saw_is_labelled_by_the_ground_rule(scene_and_truth):
    scene, truth = scene_and_truth
    place = [scan.load_points().xyz[:, :2] + [0.5 * i - 6, 0] for i, scan in enumerate(scene.scans)]
    near = [np.hypot(*xy.T) < 2 for xy in place]
    unseen = [
        ScanLabels(s.token, np.where(n, 0, s.semantic).astype(np.uint8), np.where(n, 0, s.instance))
        for s, n in zip(noisy(scene, truth), near, strict=True)
    ]
    labels = refine_scene(scene, unseen, PRESETS["best"], sensor_height=1.7).labels[0]
    below = (np.hypot(*place[0].T) < 1.2) & (truth[0] == ROAD)
    assert (labels.semantic[below] == ROAD).mean() > 0.95
    assert (labels.provenance[below] == Provenance.GROUND_RULE).mean() > 0.5


def test_what_the_cameras_said_counts_for_more_than_the_labels_made_of_it(scene_and_truth):
    scene, truth = scene_and_truth
    labels = noisy(scene, truth)
    told = []
    for scan, classes in zip(labels, truth, strict=True):
        evidence = Evidence.of_labels(classes)
        told.append(replace(scan, evidence=replace(evidence, weights=np.minimum(evidence.weights, 30))))
    with_evidence = refine_scene(scene, told, PRESETS["best"], sensor_height=1.7).labels[0].semantic
    without = refine_scene(scene, labels, PRESETS["best"], sensor_height=1.7).labels[0].semantic
    assert (with_evidence[7:] == truth[0][7:]).mean() > (without[7:] == truth[0][7:]).mean()
    published = [refine_scene(scene, side, PRESETS["paper"], sensor_height=1.7).labels[0] for side in (told, labels)]
    np.testing.assert_array_equal(published[0].semantic, published[1].semantic)
