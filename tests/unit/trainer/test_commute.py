"""A head's first convolution before the enlarging of a stack of levels."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from l3ps_trainer.commute import convolve_before_enlarging


def network(*, by_sizes=False, mode="linear", kernel=1, shown=False):
    """Two levels and a third as it is, stacked, under two convolutions."""
    rng = np.random.default_rng(0)
    weights = {
        "w0": rng.standard_normal((4, 3, 1, 1)), "w1": rng.standard_normal((5, 3, 2, 2)),
        "w2": rng.standard_normal((6, 3, 2, 2)), "a": rng.standard_normal((2, 15, kernel, kernel)),
        "b": rng.standard_normal((3, 15, 1, 1)), "bias": rng.standard_normal(2),
    }  # fmt: skip
    tensors = [numpy_helper.from_array(w.astype(np.float32), name) for name, w in weights.items()]
    enlargings = []
    for source, width in (("m1", 5), ("m2", 6)):
        wanted = np.array([1, width, 8, 12]) if by_sizes else np.array([1, 1, 2, 2], np.float32)
        tensors.append(numpy_helper.from_array(wanted, f"{source}-how"))
        inputs = [source, "", "", f"{source}-how"] if by_sizes else [source, "", f"{source}-how"]
        way = "pytorch_half_pixel" if mode == "linear" else "asymmetric"
        enlargings.append(
            helper.make_node("Resize", inputs, [f"{source}-large"], mode=mode, coordinate_transformation_mode=way)
        )
    nodes = [
        helper.make_node("Conv", ["image", "w0"], ["m0"]),
        *(helper.make_node("Conv", ["image", f"w{n}"], [f"m{n}"], strides=[2, 2]) for n in (1, 2)),
        *enlargings,
        helper.make_node("Concat", ["m0", "m1-large", "m2-large"], ["stack"], axis=1),
        helper.make_node("Conv", ["stack", "a", "bias"], ["semantic"], pads=[kernel // 2] * 4),
        helper.make_node("Conv", ["stack", "b"], ["boundary"]),
    ]
    outputs = [("semantic", 2), ("boundary", 3), *([("stack", 15)] if shown else [])]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 8, 12])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width, 8, 12]) for name, width in outputs],
        tensors,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)


def answers(model):
    image = np.random.default_rng(1).standard_normal((1, 3, 8, 12)).astype(np.float32)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(["semantic", "boundary"], {"image": image})


@pytest.mark.parametrize("by_sizes", [False, True])
def test_the_answers_stay_and_the_stack_goes(by_sizes):
    model = network(by_sizes=by_sizes)
    before = answers(model)
    assert convolve_before_enlarging(model, "stack")
    onnx.checker.check_model(model, full_check=True)
    for one, other in zip(before, answers(model), strict=True):
        assert np.abs(one - other).max() < 1e-5
    kinds = [node.op_type for node in model.graph.node]
    assert "Concat" not in kinds
    assert kinds.count("Resize") == 2, "levels of one size are summed first: one enlarging a head"
    assert {"a", "b", "m1-how"}.isdisjoint(tensor.name for tensor in model.graph.initializer)


@pytest.mark.parametrize("changes", [{"kernel": 3}, {"shown": True}])
def test_what_is_no_sum_over_levels_stays_as_it_is(changes):
    model = network(**changes)
    same = model.SerializeToString()
    assert not convolve_before_enlarging(model, "stack")
    assert model.SerializeToString() == same


def test_an_enlarging_that_is_not_bilinear_is_left_where_it_is():
    model = network(mode="nearest")
    before = answers(model)
    convolve_before_enlarging(model, "stack")
    assert [node.input[0] for node in model.graph.node if node.op_type == "Resize"] == ["m1", "m2"]
    for one, other in zip(before, answers(model), strict=True):
        assert np.abs(one - other).max() < 1e-5
