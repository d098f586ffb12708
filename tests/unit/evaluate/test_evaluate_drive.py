"""Label files against the truth of a log."""

import numpy as np
import pytest

from l3ps.drivelog.types import Truth
from l3ps.errors import LabelError
from l3ps.evaluate import PanopticEvaluator, evaluate_drive, evaluate_scene
from l3ps.labels import ScanLabels, write_scene


def truth_of(*runs, has_instances=True):
    """(n, class, id) per run of points."""
    semantic, instance = (np.repeat([run[i] for run in runs], [run[0] for run in runs]) for i in (1, 2))
    return Truth(semantic.astype(np.uint8), instance.astype(np.int32), has_instances)


def perfect(drive):
    """The truth of a drive in the 16 classes, as labels per scene."""
    return {
        scene.name: [
            ScanLabels(scan.token, scan.load_truth().semantic.copy(), scan.load_truth().instance.copy())
            for scan in scene.scans
            if scan.load_truth
        ]
        for scene in drive.scenes
    }


def write(drive, out, labels, label_format="nuscenes"):
    for scene in drive.scenes:
        write_scene(out, label_format, scene, labels[scene.name])


@pytest.fixture
def drive(make_drive):
    street = truth_of((60, 4, 1), (60, 4, 2), (60, 7, 1), (200, 11, 0), (100, 0, 0))
    park = truth_of((60, 4, 5), (300, 16, 0))
    return make_drive({"street": [street, None, street], "park": [park]})


@pytest.mark.parametrize("label_format", ["nuscenes", "semantickitti"])
@pytest.mark.parametrize("protocol", ["nuscenes", "paper"])
def test_perfect_labels_score_100_in_every_format(drive, tmp_path, protocol, label_format):
    write(drive, tmp_path, perfect(drive), label_format)
    quality = evaluate_drive(drive, tmp_path, protocol)
    assert (quality.pq, quality.miou, quality.pq_things) == (100, 100, 100)
    assert quality.scans == 3
    assert quality.classes["car"].tp == 5


def test_one_scene_can_be_asked_for(drive, tmp_path):
    labels = perfect(drive)
    labels["park"][0].semantic[:] = 15
    write(drive, tmp_path, labels)
    assert evaluate_drive(drive, tmp_path, "nuscenes", scene="street").pq == 100
    assert evaluate_drive(drive, tmp_path, "nuscenes", scene="park").pq == 0
    with pytest.raises(LabelError, match=r"no scene 'alley'.*street, park"):
        evaluate_drive(drive, tmp_path, "nuscenes", scene="alley")


def test_files_and_memory_agree(drive, tmp_path):
    labels = perfect(drive)
    for scan_labels in labels["street"]:
        scan_labels.semantic[:90] = 11
    write(drive, tmp_path, labels)
    merged = PanopticEvaluator("paper")
    for scene in drive.scenes:
        merged.merge(evaluate_scene(drive, scene, labels[scene.name], "paper"))
    assert merged.quality() == evaluate_drive(drive, tmp_path, "paper")


def test_labels_of_another_log_are_told_apart(drive, make_drive, tmp_path):
    write(drive, tmp_path, perfect(drive))
    other = make_drive({"street": [truth_of((34_688, 11, 0))]})
    with pytest.raises(
        LabelError,
        match=r"labels of scan s0: have 480 values but the scan has 34,688 points\. Were they made from another",
    ):
        evaluate_drive(other, tmp_path, "nuscenes")


def test_every_missing_file_is_named(drive, tmp_path):
    labels = perfect(drive)
    del labels["street"][1], labels["park"][0]
    write(drive, tmp_path, labels)
    with pytest.raises(LabelError) as caught:
        evaluate_drive(drive, tmp_path, "nuscenes")
    assert [(p.scene, p.scan) for p in caught.value.problems] == [("street", "s2"), ("park", "s3")]


def test_semantickitti_truth_under_its_own_protocol(make_drive, tmp_path):
    # car, person, bicyclist and pole: the 16 classes know no rider and no pole, so both are missed.
    kitti = make_drive({"00": [truth_of((80, 1, 3), (80, 6, 1), (80, 7, 2), (80, 18, 0))]}, "semantickitti")
    guess = ScanLabels(
        "s0", np.repeat([4, 7, 2, 15], 80).astype(np.uint8), np.repeat([1, 2, 3, 0], 80).astype(np.int32)
    )
    for label_format in ("nuscenes", "semantickitti"):
        write_scene(tmp_path / label_format, label_format, kitti.scenes[0], [guess])
        quality = evaluate_drive(kitti, tmp_path / label_format, "semantickitti")
        assert (quality.classes["car"].pq, quality.classes["person"].pq) == (100, 100)
        assert (quality.classes["bicyclist"].fn, quality.classes["pole"].fn) == (1, 1)
        assert quality.pq == 50
    # Under the nuScenes protocols the truth is carried over, and a rider is a bicycle.
    quality = evaluate_drive(kitti, tmp_path / "nuscenes", "nuscenes")
    assert (quality.pq, quality.classes["bicycle"].tp, quality.classes["manmade"].tp) == (100, 1, 1)


def test_carrying_truth_over_merges_no_objects(make_drive, tmp_path):
    # Bicycle 3 and bicyclist 3 become two bicycles; building and pole become one manmade segment.
    kitti = make_drive({"00": [truth_of((80, 2, 3), (80, 7, 3), (80, 13, 0), (80, 18, 0))]}, "semantickitti")
    guess = ScanLabels(
        "s0", np.repeat([2, 15], 160).astype(np.uint8), np.repeat([1, 2, 0], [80, 80, 160]).astype(np.int32)
    )
    quality = evaluate_scene(kitti, kitti.scenes[0], [guess], "nuscenes").quality()
    assert (quality.classes["bicycle"].tp, quality.classes["manmade"].tp, quality.pq) == (2, 1, 100)


def test_truth_without_instances_gives_semantic_figures_only(make_drive, tmp_path):
    kitti = make_drive({"00": [truth_of((80, 1, 0), (80, 9, 0), has_instances=False)]}, "semantickitti")
    guess = ScanLabels(
        "s0", np.repeat([4, 11], 80).astype(np.uint8), np.repeat([1, 2, 0], [40, 40, 80]).astype(np.int32)
    )
    quality = evaluate_scene(kitti, kitti.scenes[0], [guess], "semantickitti").quality()
    assert (quality.pq, quality.pq_things, quality.miou, quality.things_unscored) == (None, None, 100, ("car",))


def test_lidarseg_alone_gives_semantic_figures_only(drive, tmp_path):
    write(drive, tmp_path, perfect(drive))
    quality = evaluate_drive(drive, tmp_path / "lidarseg", "nuscenes")
    assert (quality.pq, quality.pq_things, quality.miou, quality.pq_stuff) == (None, None, 100, 100)


def test_nuscenes_truth_cannot_be_scored_in_19_classes(drive, tmp_path):
    write(drive, tmp_path, perfect(drive))
    with pytest.raises(LabelError, match=r"protocol semantickitti cannot score|Choose protocol nuscenes"):
        evaluate_drive(drive, tmp_path, "semantickitti")


def test_a_log_without_truth_says_so(make_drive, tmp_path):
    bare = make_drive({"night": [None, None]})
    with pytest.raises(LabelError, match="no annotated labels"):
        evaluate_drive(bare, tmp_path, "nuscenes")
