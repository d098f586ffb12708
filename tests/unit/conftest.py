"""A network whose answers are known: the strongest colour channel is the class."""

import json

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

HEIGHT, WIDTH = 32, 64
CLASSES = {"car": 4, "vegetation": 16, "road": 11}


def colour_graph(height=HEIGHT, width=WIDTH, classes=3, boundary=False):
    """logits = 10 * RGB; boundary = the blue channel, which the test paints as it likes."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])
    outputs = [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, classes, height, width])]
    weights = np.zeros((classes, 3, 1, 1), np.float32)
    for c in range(min(classes, 3)):
        weights[c, c] = 10
    nodes = [helper.make_node("Conv", ["image", "w"], ["logits"])]
    constants = [numpy_helper.from_array(weights, "w")]
    if boundary:
        nodes.append(helper.make_node("Conv", ["image", "b"], ["inside"]))
        constants.append(numpy_helper.from_array(np.array([[0, 0, 1]], np.float32).reshape(1, 3, 1, 1), "b"))
        outputs.append(helper.make_tensor_value_info("inside", TensorProto.FLOAT, [1, 1, height, width]))
    graph = helper.make_graph(nodes, "colours", [image], outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def description(**changes):
    info = {
        "name": "colours",
        "input": {"name": "image", "height": HEIGHT, "width": WIDTH, "range": "0..1"},
        "output": {"semantic": "logits"},
        "classes": list(CLASSES),
        "to_nuscenes": CLASSES,
    }
    info.update(changes)
    return info


@pytest.fixture
def write_bundle(tmp_path):
    """Writes a bundle directory: write_bundle(graph=…, info=…)."""

    def write(graph=None, info=None, name="bundle", description_name="model.json"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "model.onnx").write_bytes(colour_graph() if graph is None else graph)
        (folder / description_name).write_text(json.dumps(description() if info is None else info))
        return folder

    write.graph = colour_graph
    write.description = description
    return write


@pytest.fixture(scope="session")
def small_drive(tmp_path_factory):
    """A simulated drive of one scene with two scans; tests must not change it."""
    from l3ps.simulate import simulate_drive

    folder = tmp_path_factory.mktemp("simulated") / "drive"
    simulate_drive(folder, scenes=1, scans=2, seed=3)
    return folder
