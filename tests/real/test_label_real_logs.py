"""The whole method on every real recording that has images, against the figures measured for the published rules."""

from dataclasses import replace

import pytest

from l3ps.drivelog import open_drive, validate
from l3ps.evaluate import evaluate_scene
from l3ps.labels import open_labels, write_scene
from l3ps.pipeline import primal_labels, refine_scene
from l3ps.presets import PRESETS
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.session import Segmenter

pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def segmenter(real_data):
    bundle = ModelBundle.load(real_data / "models" / "espnetv2-cityscapes")
    return Segmenter(bundle, threads=2, min_area=PRESETS["paper"].min_area)


@pytest.mark.parametrize(
    ("log", "scene", "published"),
    [
        ("nuscenes-one-keyframe", "scene-0061", 31.0),
        ("urban-surround", "scene-01", 8.0),
        ("urban-surround", "scene-02", 30.4),
    ],
)
def test_the_published_rules_give_the_published_figures_and_geometry_ten_more(
    real_data, segmenter, log, scene, published
):
    drive = open_drive(real_data / "data" / log)
    (one,) = [s for s in drive.scenes if s.name == scene]
    primal = primal_labels(one, segmenter)
    figures = {}
    for preset in ("paper", "best"):
        refined = refine_scene(one, primal, PRESETS[preset], sensor_height=drive.sensor_height)
        figures[preset] = evaluate_scene(drive, one, refined.labels, "nuscenes").quality().pq_things
    assert figures["paper"] == pytest.approx(published, abs=2.0)
    assert figures["best"] > figures["paper"] + 10


@pytest.mark.parametrize(("log", "labelled"), [("kitti-raw", 0.15), ("semantickitti", 0.15)])
def test_kitti_layouts_are_labelled_and_written(real_data, segmenter, tmp_path, log, labelled):
    drive = open_drive(real_data / "data" / log)
    assert [problem for problem in validate(drive) if problem.severity != "warning"] == []
    scene = replace(drive.scenes[0], scans=drive.scenes[0].scans[:2])
    refined = refine_scene(scene, primal_labels(scene, segmenter), PRESETS["fast"], sensor_height=drive.sensor_height)
    write_scene(tmp_path, "semantickitti", scene, refined.labels)
    folder = open_labels(tmp_path)
    for scan in scene.scans:
        semantic, _ = folder.read(scene, scan, "semantickitti")
        assert len(semantic) == len(scan.load_points())
        assert (semantic > 0).mean() > labelled, "one forward camera sees a sixth of the points and more"
