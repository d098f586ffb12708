"""Bundles from strangers: what is refused, why, and that nothing but the trial's process comes to harm."""

import json
import signal
import subprocess
import sys

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from typer.testing import CliRunner

from l3ps.errors import Cancelled, ModelError, ProcessingError, Starved
from l3ps.segment import check
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.check import check_bundle
from l3ps.segment.graphs import MAX_NODES, look


def model(write_bundle, **kind):
    return onnx.load_from_string(write_bundle.graph(**kind))


def problems(write_bundle, changed, **description):
    """What a look at a changed graph finds."""
    info = write_bundle.description(**description)
    bundle = ModelBundle.load(write_bundle(graph=changed.SerializeToString(), info=info))
    return "; ".join(problem.what for problem in look(bundle, "fast").problems)


def test_a_good_bundle_is_described(write_bundle):
    passes = {"balanced": {"graph": "model-balanced.onnx", "height": 64, "width": 128}}
    output = {"semantic": "logits", "boundary": "inside"}
    folder = write_bundle(
        graph=write_bundle.graph(boundary=True), info=write_bundle.description(passes=passes, output=output)
    )
    (folder / "model-balanced.onnx").write_bytes(write_bundle.graph(64, 128, boundary=True))
    report = check_bundle(folder)
    assert (report.name, report.classes, report.boundary) == ("colours", ["car", "vegetation", "road"], True)
    assert report.sha256 == ModelBundle.load(folder).sha256
    fast, balanced = report.graphs
    assert (fast.file, fast.opset, fast.nodes, fast.int8, fast.input) == ("model.onnx", 17, 2, False, [1, 3, 32, 64])
    assert fast.outputs == {"logits": [3, 32, 64], "inside": [32, 64]}
    assert (balanced.preset, balanced.outputs["logits"]) == ("balanced", [3, 64, 128])


def test_the_command_says_what_is_inside_and_what_is_wrong(write_bundle, monkeypatch, tmp_path):
    from l3ps_cli.main import app

    told = CliRunner().invoke(app, ["model", "check", "--json", str(write_bundle())])
    assert told.exit_code == 0
    assert json.loads(told.stdout)["graphs"][0]["opset"] == 17
    bad = write_bundle(graph=b"no graph", name="bad")
    told = CliRunner().invoke(app, ["model", "check", str(bad)])
    assert told.exit_code == 2
    assert "it is no ONNX graph" in told.stderr
    assert "Traceback" not in told.stderr


def with_custom_operator(graph):
    graph.graph.node[0].domain = "evil.ops"


def with_operator_of_the_runtime(graph):
    graph.graph.node.append(helper.make_node("SampleOp", ["image"], ["s"], domain="com.microsoft"))


def with_function(graph):
    opsets = [helper.make_opsetid("", 17)]
    graph.functions.append(helper.make_function("own", "F", ["x"], ["y"], [], opsets))


def with_many_nodes(graph):
    graph.graph.node.extend([graph.graph.node[0]] * MAX_NODES)


def with_nested_graphs(graph):
    inner = helper.make_graph([helper.make_node("Identity", ["image"], ["z"])], "g", [], [])
    for _ in range(4):
        inner = helper.make_graph([helper.make_node("If", ["c"], ["z"], then_branch=inner)], "g", [], [])
    graph.graph.node.extend(inner.node)


def with_custom_operator_in_a_branch(graph):
    inner = helper.make_graph([helper.make_node("Bad", [], ["z"], domain="evil")], "g", [], [])
    graph.graph.node.append(helper.make_node("If", ["c"], ["z"], then_branch=inner, else_branch=inner))


def with_huge_initializer(graph):
    graph.graph.initializer.append(TensorProto(name="huge", dims=[1 << 40], data_type=1))


def with_negative_initializer(graph):
    graph.graph.initializer.append(TensorProto(name="odd", dims=[-1, 4], data_type=1))


def with_huge_declaration(graph):
    graph.graph.value_info.append(helper.make_tensor_value_info("x", 1, [1 << 20, 1 << 20]))


def with_second_input(graph):
    graph.graph.input.append(helper.make_tensor_value_info("key", 1, [1]))


def with_integer_input(graph):
    graph.graph.input[0].type.tensor_type.elem_type = TensorProto.UINT8


def without_nodes(graph):
    graph.graph.ClearField("node")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (with_custom_operator, "custom operators evil.ops.Conv"),
        (with_operator_of_the_runtime, "custom operators com.microsoft.SampleOp"),
        (with_custom_operator_in_a_branch, "custom operators evil.Bad"),
        (with_function, "defines 1 functions"),
        (with_many_nodes, "has 50001 operators"),
        (with_nested_graphs, "nested 3 deep"),
        (with_huge_initializer, "'huge' is declared as [1099511627776]"),
        (with_negative_initializer, "'odd' is declared as [-1, 4]"),
        (with_huge_declaration, "'x' is declared as [1048576, 1048576]"),
        (with_second_input, "wants further inputs (key)"),
        (with_integer_input, "input 'image' is of type 2"),
        (without_nodes, "holds no operators"),
    ],
)
def test_what_a_segmenter_does_not_need_is_refused(write_bundle, change, expected):
    graph = model(write_bundle)
    change(graph)
    assert expected in problems(write_bundle, graph)


@pytest.mark.parametrize(
    ("description", "expected"),
    [
        ({"input": {"name": "image", "height": 48, "width": 64}}, "input 'image' has the shape [1, 3, 32, 64]"),
        ({"input": {"name": "picture", "height": 32, "width": 64}}, "no input 'picture' (it has image)"),
        ({"output": {"semantic": "classes"}}, "no output 'classes' (it has logits)"),
        ({"output": {"semantic": "logits", "boundary": "logits"}}, "output 'logits' has the shape [1, 3, 32, 64]"),
        ({"classes": ["car"]}, "output 'logits' has the shape [1, 3, 32, 64], model.json says [1, 1, 'any', 'any']"),
        ({"classes": ["car", "car", "road"]}, "names a class twice"),
        ({"to_nuscenes": {"car": 0, "vegetation": 0, "road": 0}}, "maps every class to void"),
    ],
)
def test_a_description_of_another_graph_is_refused(write_bundle, description, expected):
    assert expected in problems(write_bundle, model(write_bundle), **description)


def test_the_operators_of_our_own_int8_export_are_no_custom_ones(write_bundle, tmp_path):
    from onnxruntime.quantization import QuantType, quantize_dynamic

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 32, 64])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, 32, 64])
    weights = numpy_helper.from_array(np.eye(64, dtype=np.float32), "w")
    nodes = [helper.make_node("MatMul", ["image", "w"], ["logits"])]
    graph = helper.make_graph(nodes, "g", [image], [logits], [weights])
    whole = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(whole, tmp_path / "f.onnx")
    quantize_dynamic(tmp_path / "f.onnx", tmp_path / "q.onnx", weight_type=QuantType.QInt8)
    bundle = ModelBundle.load(write_bundle(graph=(tmp_path / "q.onnx").read_bytes()))
    seen = look(bundle, "fast")
    assert seen.problems == []
    assert seen.facts["int8"] is True
    assert check_bundle(tmp_path / "bundle").graphs[0].int8


def hungry(graph):
    """Asks for 3 GB, three times what the trial may take."""
    graph.graph.initializer.append(numpy_helper.from_array(np.array([750, 1_000_000]), "shape"))
    graph.graph.node.insert(0, helper.make_node("ConstantOfShape", ["shape"], ["much"]))
    graph.graph.node.insert(1, helper.make_node("ReduceMax", ["much"], ["most"], keepdims=0))
    graph.graph.node[-1].output[0] = "raw"
    graph.graph.node.append(helper.make_node("Add", ["raw", "most"], ["logits"]))


def endless(graph):
    """Counts to four billion billion."""
    graph.graph.initializer.append(numpy_helper.from_array(np.array(1 << 62), "times"))
    graph.graph.initializer.append(numpy_helper.from_array(np.array(True), "yes"))
    count, on = (helper.make_tensor_value_info(n, t, []) for n, t in (("i", TensorProto.INT64), ("on", 9)))
    state, after = (helper.make_tensor_value_info(n, 1, None) for n in ("state", "after"))
    still = helper.make_tensor_value_info("still", 9, [])
    nodes = [helper.make_node("Identity", ["on"], ["still"]), helper.make_node("Identity", ["state"], ["after"])]
    body = helper.make_graph(nodes, "body", [count, on, state], [still, after])
    graph.graph.node[-1].output[0] = "raw"
    graph.graph.node.append(helper.make_node("Loop", ["times", "yes", "raw"], ["logits"], body=body))


def undefined(graph):
    """Divides by zero."""
    graph.graph.initializer.append(numpy_helper.from_array(np.zeros((), np.float32), "zero"))
    graph.graph.node[-1].output[0] = "raw"
    graph.graph.node.append(helper.make_node("Div", ["raw", "zero"], ["logits"]))


@pytest.mark.parametrize(
    ("change", "seconds", "expected"),
    [
        (hungry, 60, "(onnxruntime cannot load the graph|it cannot run one image|was ended by|does not fit)"),
        (endless, 6, "(took more than 6 s|was ended by)"),
        (undefined, 60, "output 'logits' has values that are not finite"),
    ],
)
def test_a_graph_that_does_harm_when_run_is_refused_and_harms_nobody(write_bundle, change, seconds, expected):
    graph = model(write_bundle)
    change(graph)
    with pytest.raises(ModelError, match=expected):
        check_bundle(write_bundle(graph=graph.SerializeToString()), memory=1 << 30, seconds=seconds)


def test_logits_under_the_name_of_the_boundary_are_refused(write_bundle):
    graph = model(write_bundle, boundary=True)
    graph.graph.initializer[1].CopyFrom(numpy_helper.from_array(np.full((1, 3, 1, 1), 5, np.float32), "b"))
    info = write_bundle.description(output={"semantic": "logits", "boundary": "inside"})
    with pytest.raises(ModelError, match="is no probability"):
        check_bundle(write_bundle(graph=graph.SerializeToString(), info=info))


def test_whoever_waits_may_stop_waiting(write_bundle):
    def stop(stage, done, total):
        raise Cancelled

    with pytest.raises(Cancelled):
        check_bundle(write_bundle(), progress=stop)


def test_a_check_that_does_not_work_is_not_the_models_fault(write_bundle, monkeypatch):
    monkeypatch.setattr(check.sys, "executable", "/bin/false")
    with pytest.raises(ProcessingError, match="did not work"):
        check_bundle(write_bundle())


@pytest.mark.parametrize(
    ("does", "lack", "said"),
    [
        ("kill -KILL $$", "memory", "free memory"),
        ("kill -TERM $$", "time", "SIGTERM"),
        ("exec sleep 600", "time", "hardly any processor time"),
    ],
    ids=["killed", "stopped", "never-served"],
)
def test_what_the_machine_does_to_a_trial_is_not_the_models_fault(
    write_bundle, monkeypatch, tmp_path, does, lack, said
):
    interpreter = tmp_path / "interpreter"
    interpreter.write_text(f"#!/bin/sh\n{does}\n")
    interpreter.chmod(0o755)
    monkeypatch.setattr(check.sys, "executable", str(interpreter))
    with pytest.raises(Starved, match=said) as caught:
        check_bundle(write_bundle(), seconds=0.2)
    assert caught.value.lack == lack


def test_a_trial_out_of_its_own_time_says_so(write_bundle):
    """Its limit of processor time ends it in another way than the kernel does when memory is short."""
    spin = "import os; from l3ps.segment.trial import limit; limit(8 << 30, 0)\nwhile True: pass"
    assert subprocess.run([sys.executable, "-c", spin], check=False, timeout=60).returncode == -signal.SIGXCPU
