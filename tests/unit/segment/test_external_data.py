"""Weights in files beside the graph, and further graphs: what is read, and what is refused."""

import stat
import zipfile

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper

from l3ps.errors import ModelError
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.external import MAX_FIELDS, external_tensors

WEIGHTS = np.eye(3, dtype=np.float32) * 10


def moved_out(graph, location="weights.bin", name="w", **entries):
    """The same graph with the data of an initializer in a file."""
    model = onnx.load_from_string(graph)
    tensor = next(t for t in model.graph.initializer if t.name == name)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, "offset": "4", "length": "36", **entries}.items():
        if value is not None:
            tensor.external_data.add(key=key, value=value)
    return model.SerializeToString()


def bundle(write_bundle, graph, data=b"\0\0\0\0" + WEIGHTS.tobytes()):
    folder = write_bundle(graph=graph)
    if data is not None:
        (folder / "weights.bin").write_bytes(data)
    return folder


def test_weights_in_a_file_are_held_in_memory_and_feed_the_runtime(write_bundle, tmp_path, monkeypatch):
    folder = bundle(write_bundle, moved_out(write_bundle.graph()))
    loaded = ModelBundle.load(folder)
    (folder / "weights.bin").unlink()
    monkeypatch.chdir(tmp_path)
    options = ort.SessionOptions()
    names, contents = list(loaded.data), list(loaded.data.values())
    options.add_external_initializers_from_files_in_memory(names, contents, [len(c) for c in contents])
    session = ort.InferenceSession(loaded.graph, options, providers=["CPUExecutionProvider"])
    image = np.random.default_rng(0).random((1, 3, 32, 64), dtype=np.float32)
    np.testing.assert_allclose(session.run(None, {"image": image})[0], image * 10, rtol=1e-6)


def test_the_digest_covers_the_data(write_bundle):
    folder = bundle(write_bundle, moved_out(write_bundle.graph()))
    first = ModelBundle.load(folder)
    (folder / "weights.bin").write_bytes(bytes(40))
    assert ModelBundle.load(folder).sha256 != first.sha256
    assert set(first.data) == {"weights.bin"}


@pytest.mark.parametrize(
    "location",
    [
        "/etc/passwd",
        "../weights.bin",
        "sub/weights.bin",
        "..\\weights.bin",
        "C:weights.bin",
        "*/_ORT_MEM_ADDR_/*",
        ".",
        "..",
        ".hidden",
        "weights.bin\0",
        "",
    ],
)
def test_data_outside_the_bundle_is_refused(write_bundle, location):
    with pytest.raises(ModelError, match="which is no file of the bundle"):
        ModelBundle.load(bundle(write_bundle, moved_out(write_bundle.graph(), location)))


@pytest.mark.parametrize(
    ("entries", "data", "expected"),
    [
        ({}, None, "names this file but does not hold it"),
        ({}, bytes(39), "ends at byte 40 of weights.bin, which has 39"),
        ({"offset": str(1 << 62)}, bytes(40), "ends at byte 4611686018427387940"),
        ({"offset": "-8"}, bytes(40), "36 from -8"),
        ({"offset": "x"}, bytes(40), "is no number"),
        ({"length": "35"}, bytes(40), "takes 36 bytes, its external data is 35"),
    ],
)
def test_data_that_is_not_there_is_refused(write_bundle, entries, data, expected):
    with pytest.raises(ModelError, match=expected):
        ModelBundle.load(bundle(write_bundle, moved_out(write_bundle.graph(), **entries), data))


def test_a_link_is_refused_in_a_folder_and_in_a_zip(write_bundle, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(40))
    folder = bundle(write_bundle, moved_out(write_bundle.graph()), None)
    (folder / "weights.bin").symlink_to(tmp_path / "secret")
    with pytest.raises(ModelError, match="it is a link"):
        ModelBundle.load(folder)

    with zipfile.ZipFile(tmp_path / "bundle.zip", "w") as archive:
        for name in ("model.onnx", "model.json"):
            archive.write(folder / name, name)
        link = zipfile.ZipInfo("weights.bin")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "../secret".ljust(40))
    with pytest.raises(ModelError, match="it is a link"):
        ModelBundle.load(tmp_path / "bundle.zip")


def constant(tensor):
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.add(name="value", type=onnx.AttributeProto.TENSOR).t.CopyFrom(tensor)
    return node


def subgraph(tensor):
    inner = helper.make_graph([], "inner", [], [helper.make_tensor_value_info("s", 1, [9])], [tensor])
    return helper.make_node("If", ["yes"], ["c"], then_branch=inner, else_branch=inner)


@pytest.mark.parametrize("place", [constant, subgraph])
def test_external_data_anywhere_but_in_the_main_graphs_initializers_is_refused(write_bundle, place):
    tensor = TensorProto(name="s", dims=[9], data_type=TensorProto.FLOAT, data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="weights.bin")
    model = onnx.load_from_string(write_bundle.graph())
    model.graph.node.append(place(tensor))
    with pytest.raises(ModelError, match="no initializer of the main graph"):
        ModelBundle.load(bundle(write_bundle, model.SerializeToString()))


@pytest.mark.parametrize(
    ("graph", "expected"),
    [
        (b"location", "no ONNX graph"),
        (b"\x3a\xff\xff\xff\xff\x0flocation", "runs past the end"),
        (b"\x3a" + b"\xff" * 20 + b"location", "more than ten bytes"),
        (b"\x00\x00" * (MAX_FIELDS + 1) + b"location", "parts"),
    ],
)
def test_a_graph_that_is_not_one_is_refused_without_harm(graph, expected):
    with pytest.raises(ValueError, match=expected):
        external_tensors(graph)


def test_a_pass_has_its_own_graph_and_size(write_bundle):
    passes = {"balanced": {"graph": "model-balanced.onnx", "height": 64, "width": 128}}
    folder = write_bundle(info=write_bundle.description(passes=passes))
    with pytest.raises(ModelError, match=r"model-balanced\.onnx.*does not hold it"):
        ModelBundle.load(folder)
    larger = write_bundle.graph(64, 128)
    (folder / "model-balanced.onnx").write_bytes(larger)
    loaded = ModelBundle.load(folder)
    graph, spec = loaded.graph_for("balanced")
    assert graph == larger
    assert (spec.name, spec.height, spec.width) == ("image", 64, 128)
    assert loaded.graph_for("fast") == loaded.graph_for("paper") == (loaded.graph, loaded.info.input)
    assert loaded.sha256 != ModelBundle.load(write_bundle(name="plain")).sha256


def test_a_bundle_without_a_pass_says_how_to_get_one(write_bundle):
    with pytest.raises(ModelError, match=r"no graph for the preset 'balanced'.*l3ps train"):
        ModelBundle.load(write_bundle()).graph_for("balanced")


def test_a_pass_that_leaves_the_bundle_is_refused(write_bundle):
    passes = {"balanced": {"graph": "../model.onnx", "height": 64, "width": 128}}
    with pytest.raises(ModelError, match=r"passes\.balanced\.graph"):
        ModelBundle.load(write_bundle(info=write_bundle.description(passes=passes)))


def test_a_zip_bomb_is_refused_before_it_is_unpacked(write_bundle, tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(write_bundle() / "model.json", "model.json")
        archive.writestr("model.onnx", bytes(70 << 20))
    with pytest.raises(ModelError, match="as no weights do"):
        ModelBundle.load(tmp_path / "bomb.zip")
