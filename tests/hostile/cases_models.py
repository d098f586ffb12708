"""Model bundles from strangers: other files, lies in the description, and graphs that reach out or never end."""

import io
import json
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from .archives import tarred, zip_of_kind, zipped
from .case import Case, case
from .samples import Samples


class _Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (eval, ("__import__('os').abort()",))


PICKLE = pickle.dumps(_Evil())


def _graph(change: Callable[[Any], object]) -> Callable[[Samples], bytes]:
    """The bundle with a changed network."""

    def make(samples: Samples) -> bytes:
        network = onnx.load_from_string(samples.bundle["model.onnx"])
        change(network)
        return samples.model(model_onnx=network.SerializeToString())

    return make


def _outside(location: str) -> Callable[[Any], object]:
    def change(network: Any) -> None:
        weights = network.graph.initializer[0]
        weights.ClearField("raw_data")
        weights.data_location = TensorProto.EXTERNAL
        for key, value in (("location", location), ("offset", "0"), ("length", "36")):
            entry = weights.external_data.add()
            entry.key, entry.value = key, value

    return change


def _circle(network: Any) -> None:
    network.graph.ClearField("node")
    for a, b in (("x", "y"), ("y", "x")):
        network.graph.node.append(helper.make_node("Identity", [a], [b]))
    network.graph.node.append(helper.make_node("Add", ["x", "image"], ["logits"]))


def _huge_output(network: Any) -> None:
    """400 GB, asked for while it runs."""
    shape = numpy_helper.from_array(np.array([1, 3, 100_000, 333_333], np.int64), "shape")
    network.graph.initializer.append(shape)
    network.graph.ClearField("node")
    network.graph.node.append(helper.make_node("ConstantOfShape", ["shape"], ["zeros"]))
    network.graph.node.append(helper.make_node("Add", ["zeros", "image"], ["logits"]))


def _huge_initializer(network: Any) -> None:
    network.graph.initializer.append(TensorProto(name="huge", dims=[1 << 40], data_type=1))


def _not_finite(network: Any) -> None:
    weights = np.full((3, 3, 1, 1), np.nan, np.float32)
    network.graph.initializer[0].CopyFrom(numpy_helper.from_array(weights, "w"))


def _custom(network: Any) -> None:
    network.graph.node[0].domain = "evil.ops"
    network.opset_import.append(helper.make_opsetid("evil.ops", 1))


def endless(network: Any) -> None:
    """A loop of 10¹² turns."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Identity", ["state"], ["next"])],
        "turn",
        [
            helper.make_tensor_value_info("turn", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("state", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("next", TensorProto.FLOAT, None),
        ],
    )
    network.graph.initializer.append(numpy_helper.from_array(np.array(10**12, np.int64), "turns"))
    network.graph.initializer.append(numpy_helper.from_array(np.array(True), "yes"))
    network.graph.node[0].output[0] = "once"
    network.graph.node.append(helper.make_node("Loop", ["turns", "yes", "once"], ["logits"], body=body))


def _torch_archive(_: Samples) -> bytes:
    return zipped({"archive/data.pkl": PICKLE, "archive/version": b"3\n", "archive/data/0": bytes(64)})


def _text(text: str) -> Callable[[Samples], bytes]:
    return lambda s: zipped(s.bundle | {"model.json": text.encode()})


def _linked(samples: Samples) -> bytes:
    """model.json as a link; what it leads to must not be read."""
    return zip_of_kind("model.json", 0o120777, b"/etc/passwd")


def _input(**fields: object) -> Callable[[Samples], bytes]:
    return lambda s: s.model({"input": json.loads(s.bundle["model.json"])["input"] | fields})


INCOMPLETE, JSON, GRAPH = "incomplete-model", "bad-model-json", "bad-graph"
CASES: list[Case] = [
    case("pickle", PICKLE, "not-an-archive", "model-pickle", end="completion"),
    case("tar", lambda s: tarred(s.bundle), "not-an-archive", "model-tar", end="completion"),
    case("onnx-alone", lambda s: s.bundle["model.onnx"], "not-an-archive", end="completion"),
    case("torch-archive", _torch_archive, INCOMPLETE),
    case("drive-as-model", lambda s: s.zip(), INCOMPLETE),
    case("no-description", lambda s: zipped({"model.onnx": s.bundle["model.onnx"]}), INCOMPLETE),
    case("half", lambda s: zipped(s.bundle)[:400], "not-a-model"),
    case("link", _linked, INCOMPLETE),
    case("pickle-as-graph", lambda s: s.model(model_onnx=PICKLE), GRAPH),
    case("empty-graph", lambda s: s.model(model_onnx=b""), "empty-model"),
    case("bomb-as-graph", lambda s: zipped(s.bundle | {"model.onnx": bytes(80 << 20)}, 8), "model-too-large"),
    case("external-outside", _graph(_outside("../../../etc/passwd")), "bad-external-data"),
    case("external-absolute", _graph(_outside("/etc/passwd")), "bad-external-data"),
    case("external-missing", _graph(_outside("weights.bin")), INCOMPLETE),
    case("custom-operators", _graph(_custom), "custom-operator"),
    case("circle", _graph(_circle), GRAPH),
    case("huge-output", _graph(_huge_output), f"{GRAPH} model-failed-trial"),
    case("huge-initializer", _graph(_huge_initializer), "model-too-large"),
    case("not-finite", _graph(_not_finite), GRAPH),
    case("json-no-json", _text("{"), JSON, "model.json"),
    case("json-deep", _text("[" * 100_000), JSON, "model.json"),
    case("json-list", _text("[]"), JSON, "model.json"),
    case("json-large", _text('"' + "a" * (2 << 20) + '"'), "model-too-large", "model.json"),
    case("json-nan", _input(mean=[float("nan")] * 3), JSON, "model.json"),
    case("size-zero", _input(height=0), JSON, "model.json"),
    case("size-huge", _input(height=10**9, width=10**9), JSON, "model.json"),
    case("size-other-than-graph", _input(height=8000, width=8000), GRAPH),
    case("name-leads-out", lambda s: s.model({"name": "../../evil"}), JSON, "model.json"),
    case("class-of-nul", lambda s: s.model({"classes": ["\0"], "to_nuscenes": {"\0": 4}}), JSON, "model.json"),
    case("class-of-half-a-pair", lambda s: s.model({"classes": ["\ud800"]}), JSON, "model.json"),
    case("class-outside", lambda s: s.model({"to_nuscenes": {"car": 99, "vegetation": 16, "road": 11}}), JSON, "model"),
    case("classes-too-many", lambda s: s.model({"classes": ["car"] * 999}), f"{GRAPH} {JSON}"),
    case("no-such-output", lambda s: s.model({"output": {"semantic": "none"}}), GRAPH),
]
CASES = [Case(f"model-{one.name}.zip", one.make, one.codes, one.where, one.end, "model") for one in CASES]


def small_network() -> bytes:
    """Three classes by colour."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 32, 64])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, 32, 64])
    weights = numpy_helper.from_array(np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1), "w")
    node = helper.make_node("Conv", ["image", "w"], ["logits"])
    graph = helper.make_graph([node], "colours", [image], [logits], [weights])
    network = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    out = io.BytesIO(network.SerializeToString())
    return out.getvalue()


def small_bundle() -> dict[str, bytes]:
    """A bundle that passes its check."""
    classes = {"car": 4, "vegetation": 16, "road": 11}
    description = {
        "name": "colours",
        "input": {"name": "image", "height": 32, "width": 64},
        "output": {"semantic": "logits"},
        "classes": list(classes),
        "to_nuscenes": classes,
    }
    return {"model.onnx": small_network(), "model.json": json.dumps(description).encode()}
