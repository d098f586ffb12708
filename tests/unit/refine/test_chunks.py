"""A scene in chunks: every scan once, the labels of the whole, and no id that ends at a seam."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l3ps.drivelog.types import Points, Scan, Scene
from l3ps.labels.types import ScanLabels
from l3ps.pipeline import refine_scene
from l3ps.presets import FAST, PAPER
from l3ps.refine.chunks import Chunk, plan
from l3ps.refine.instances import correct_instances

CAR, ROAD, MANMADE = 4, 11, 15


@given(st.lists(st.integers(0, 50), min_size=1, max_size=40), st.integers(1, 200), st.sets(st.integers(1, 39)))
def test_chunks_keep_every_scan_once_and_stay_in_the_budget(sizes, max_points, cuts):
    starts = (0, *sorted(cut for cut in cuts if cut < len(sizes)))
    chunks = plan(sizes, starts, max_points)
    kept = [scan for chunk in chunks for scan in range(chunk.kept_first, chunk.kept_stop)]
    assert kept == list(range(len(sizes)))
    for chunk in chunks:
        assert chunk.first <= chunk.kept_first <= chunk.kept_stop <= chunk.stop
        assert sum(sizes[chunk.first : chunk.stop]) <= max_points or chunk.stop - chunk.first == 1
        assert not any(chunk.first < start < chunk.stop for start in starts), "a chunk reaches over a cut"


def test_neighbouring_chunks_share_a_quarter_and_each_keeps_what_is_central():
    assert plan([10] * 12, max_points=80) == [Chunk(0, 8, 0, 7), Chunk(6, 12, 7, 12)]
    assert plan([10] * 12, max_points=120) == [Chunk(0, 12, 0, 12)]
    assert plan([10] * 12) == [Chunk(0, 12, 0, 12)]
    assert plan([10] * 4, starts=(0, 3)) == [Chunk(0, 3, 0, 3), Chunk(3, 4, 3, 4)]
    assert plan([]) == []


@pytest.fixture(scope="module")
def long_street():
    """Twelve scans along a street with a wall and a parked car every 12 m, 6,000 points each; and their truth."""
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(-40, 100, 30000), rng.uniform(-8, 8, 30000), rng.normal(-1.7, 0.01, 30000)])
    wall = np.column_stack([rng.uniform(-40, 100, 20000), rng.choice([-9, 9], 20000), rng.uniform(-1.7, 3, 20000)])
    cars = []
    for number in range(11):
        x = -36 + 12 * number
        cars.append(np.column_stack([rng.uniform(x, x + 4, 900), rng.uniform(3, 5, 900), rng.uniform(-1.4, -0.1, 900)]))
    world = np.concatenate([ground, wall, *cars])
    truth = np.repeat([ROAD, MANMADE, CAR], [30000, 20000, 9900]).astype(np.uint8)
    object_of = np.repeat(np.arange(12), [50000, *[900] * 11])
    scans, primal, objects = [], [], []
    for index in range(12):
        near = np.abs(world[:, 0] - 4 * index) < 30
        chosen = rng.permutation(np.flatnonzero(near))[:6000]
        xyz = world[chosen] + rng.normal(0, 0.01, (6000, 3)) - [4 * index, 0, 0]
        points = Points(xyz.astype(np.float32), np.full(6000, 0.3, np.float32))
        pose = np.eye(4)
        pose[0, 3] = 4 * index
        token = f"scan{index}"
        scans.append(Scan(token, index, index * 500_000, None, np.eye(4), pose, (), lambda points=points: points))
        semantic = np.where(rng.random(6000) < 0.15, MANMADE, truth[chosen]).astype(np.uint8)
        primal.append(ScanLabels(token, semantic, np.where(semantic == CAR, object_of[chosen], 0).astype(np.int32)))
        objects.append(object_of[chosen])
    return Scene("street", tuple(scans)), primal, objects


def test_chunks_give_the_labels_of_the_whole_and_the_same_objects(long_street):
    scene, primal, objects = long_street
    largest = []

    def spy(points, *rest, **named):
        from l3ps.refine.cluster import hdbscan_package

        largest.append(len(points))
        return hdbscan_package(points, *rest, **named)

    whole = refine_scene(scene, primal, FAST, sensor_height=1.7, clusterer=spy)
    biggest = max(largest)
    largest.clear()
    seen = []
    chunked = refine_scene(
        scene,
        primal,
        FAST,
        sensor_height=1.7,
        clusterer=spy,
        max_points=30000,
        progress=lambda stage, done, total: seen.append((stage, done / total)),
    )
    assert max(largest) < 0.6 * biggest
    for stage in ("cluster", "instances"):
        told = [share for name, share in seen if name == stage]
        assert told == sorted(told) and told[-1] == 1
    assert [labels.token for labels in chunked.labels] == [scan.token for scan in scene.scans]
    assert [estimate.token for estimate in chunked.estimates] == [scan.token for scan in scene.scans]
    np.testing.assert_array_equal(chunked.poses, whole.poses)
    differ = [(one.semantic != other.semantic).mean() for one, other in zip(chunked.labels, whole.labels, strict=True)]
    assert np.mean(differ) < 0.02
    pairs = set()
    for one, other in zip(chunked.labels, whole.labels, strict=True):
        same = (one.semantic == other.semantic) & (one.semantic == CAR)
        pairs |= set(zip(one.instance[same].tolist(), other.instance[same].tolist(), strict=True))
    assert len(pairs) == len({one for one, _ in pairs}) == len({other for _, other in pairs}), "no id is cut or joined"
    for labels, truth in zip(chunked.labels, objects, strict=True):
        for car in range(1, 12):
            ids = labels.instance[(truth == car) & (labels.semantic == CAR)]
            if len(ids) > 30:
                assert (ids == np.bincount(ids).argmax()).mean() > 0.95


def test_in_chunks_too_the_published_rule_mends_each_scans_own_ids(long_street):
    scene, primal, _ = long_street
    refined = refine_scene(scene, primal, PAPER, sensor_height=1.7, max_points=30000).labels
    changed = 0
    for scan, before, after in zip(scene.scans, primal, refined, strict=True):
        given = (before.semantic, before.instance, after.semantic)
        np.testing.assert_array_equal(after.instance, correct_instances(scan.load_points().xyz, *given))
        changed += ((after.semantic == CAR) & (before.semantic != CAR)).sum()
    assert changed > 100, "the rule must have had something to do"
