"""Images in two lanes: in order, in bounded memory, and nothing left behind."""

import threading
from contextlib import nullcontext

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from l3ps.drivelog import open_drive
from l3ps.errors import Cancelled, DriveLogError
from l3ps.pipeline import primal_labels
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.images import read_rgb
from l3ps.segment.session import Segmenter
from l3ps.segment.stream import in_order


def lanes() -> set[str]:
    return {thread.name for thread in threading.enumerate() if thread.name.startswith("l3ps-lane")}


def test_results_come_in_order_however_long_each_takes():
    second_done = threading.Event()

    def work(item):
        if item == 0:
            assert second_done.wait(30), "the second lane went ahead meanwhile"
        if item == 1:
            second_done.set()
        return item

    assert list(in_order(work, range(20), lanes=2, ahead=4)) == list(range(20))
    assert lanes() == set()


@pytest.mark.parametrize(("lanes_", "ahead"), [(1, 2), (2, 4), (3, 3)])
def test_no_more_is_taken_than_may_be_in_flight(lanes_, ahead):
    taken = []

    def items():
        for item in range(50):
            taken.append(item)
            yield item

    for received, _ in enumerate(in_order(lambda item: item, items(), lanes=lanes_, ahead=ahead)):
        assert len(taken) - received <= ahead
    assert len(taken) == 50


def test_an_error_is_raised_in_its_turn_and_what_was_not_begun_never_is():
    begun = []

    def work(item):
        begun.append(item)
        if item == 3:
            raise ValueError(item)
        return item

    results = in_order(work, range(1000), lanes=2, ahead=4)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="3"):
        next(results)
    assert lanes() == set()
    assert max(begun) <= 3 + 4


def test_closing_early_asks_to_stop_and_waits_for_what_runs():
    stop, ended = threading.Event(), []

    def work(item):
        if item > 0:
            assert stop.wait(30)
        ended.append(item)
        return item

    results = in_order(work, range(100), lanes=2, ahead=4, stop=stop.set)
    assert next(results) == 0
    results.close()
    assert lanes() == set()
    assert set(ended) <= {0, 1, 2, 3}


@pytest.fixture
def segmenter(write_bundle):
    return Segmenter(ModelBundle.load(write_bundle()), threads=2)


@pytest.fixture
def pictures(tmp_path):
    """Seven images, each with another number of red blobs, cars to the network, on blue road."""
    paths = []
    for cars in range(7):
        image = np.zeros((64, 256, 3), np.uint8)
        image[..., 2] = 255
        for car in range(cars):
            image[20:40, 8 + 34 * car : 30 + 34 * car] = (255, 0, 0)
        paths.append(tmp_path / f"{cars}.png")
        Image.fromarray(image).save(paths[-1])
    return paths


def test_a_stream_gives_what_one_image_at_a_time_gives(segmenter, pictures):
    streamed = list(segmenter.stream(pictures))
    assert [int(labels.instance.max()) for labels in streamed] == list(range(7))
    for labels, path in zip(streamed, pictures, strict=True):
        alone = segmenter.segment(read_rgb(path))
        np.testing.assert_array_equal(labels.semantic, alone.semantic)
        np.testing.assert_array_equal(labels.instance, alone.instance)
        np.testing.assert_array_equal(labels.scores.logits, alone.scores.logits)
        assert labels.size == alone.size == (256, 64)


def test_files_are_read_only_a_few_ahead(segmenter, pictures):
    asked = []

    def paths():
        for path in pictures * 4:
            asked.append(path)
            yield path

    for received, _ in enumerate(segmenter.stream(paths())):
        assert len(asked) - received <= 4


def test_a_broken_image_is_named_in_its_turn(segmenter, pictures):
    pictures[3].write_bytes(pictures[3].read_bytes()[:50])
    stream = segmenter.stream(pictures)
    assert [int(next(stream).instance.max()) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(DriveLogError, match=r"3\.png.*decoded"):
        next(stream)
    assert lanes() == set()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_number_of_threads_changes_no_label(write_bundle, pictures, threads):
    counts = [s.instance.max() for s in Segmenter(ModelBundle.load(write_bundle()), threads).stream(pictures)]
    assert counts == list(range(7))


def test_no_threads_are_refused(write_bundle):
    with pytest.raises(ValueError, match="at least 1"):
        Segmenter(ModelBundle.load(write_bundle()), threads=0)


def test_cancelling_a_scene_stops_between_images_and_leaves_nothing_running(small_drive, segmenter):
    (scene,) = open_drive(small_drive).scenes
    told = []

    def cancel(stage, done, total):
        told.append((stage, done, total))
        if done == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        primal_labels(scene, segmenter, cancel)
    cameras = sum(len(scan.cameras) for scan in scene.scans)
    assert told == [("segment", 1, cameras), ("segment", 2, cameras)]
    assert lanes() == set()
    assert len(primal_labels(scene, segmenter)) == len(scene.scans), "the session serves the next scene"


def patient_graph():
    """The logits are the image, after ten million rounds of nothing for each unit of its brightest value."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 32, 64])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, 32, 64])
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Identity", ["x"], ["same"])],
        "body",
        [
            helper.make_tensor_value_info("round", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 32, 64]),
        ],
        [
            helper.make_tensor_value_info("on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("same", TensorProto.FLOAT, [1, 3, 32, 64]),
        ],
    )
    nodes = [
        helper.make_node("ReduceMax", ["image"], ["brightest"], keepdims=0),
        helper.make_node("Mul", ["brightest", "rounds"], ["many"]),
        helper.make_node("Cast", ["many"], ["count"], to=TensorProto.INT64),
        helper.make_node("Loop", ["count", "", "image"], ["logits"], body=body),
    ]
    constants = [numpy_helper.from_array(np.float32(1e7), "rounds")]
    graph = helper.make_graph(nodes, "patient", [image], [logits], constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9).SerializeToString()


def test_a_pass_that_is_under_way_is_cut_short(write_bundle, tmp_path):
    begun, steps = threading.Semaphore(0), []

    def clock(step):
        steps.append(step)
        if step == "network":
            begun.release()
        return nullcontext()

    segmenter = Segmenter(ModelBundle.load(write_bundle(graph=patient_graph())), threads=2, clock=clock)
    paths = [tmp_path / f"{shade}.png" for shade in (0, 255)]
    for path in paths:
        Image.fromarray(np.full((32, 64, 3), int(path.stem), np.uint8)).save(path)
    stream = segmenter.stream(paths)
    next(stream)
    for _ in paths:
        assert begun.acquire(timeout=30)
    stream.close()
    assert steps.count("label") == 1, "the bright image did not get beyond the network"
    assert lanes() == set()
