"""The first convolution of a head before the enlarging of the features it works on, in a graph.

Many backbones end by enlarging maps of several levels to one size and stacking them. A head's 1×1 convolution over the
stack is a sum of 1×1 convolutions over the levels, and bilinear enlarging commutes with each of them exactly: both are
linear, one over channels, the other over pixels with weights that add up to 1. Convolved first, the small maps stay
small, and the stack is never made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import NodeProto, helper, numpy_helper

_Array = NDArray[Any]


def convolve_before_enlarging(model: onnx.ModelProto, stacked: str) -> bool:
    """Rewrite a graph in place where its features are a stack of levels that 1×1 convolutions alone read.

    Args:
        model: to rewrite.
        stacked: name of the features.

    Returns:
        Whether the graph could be rewritten; else it is as it was.
    """
    graph = model.graph
    made_by = {output: node for node in graph.node for output in node.output}
    weights = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    stack, readers = made_by.get(stacked), [node for node in graph.node if stacked in node.input]
    if stack is None or stack.op_type != "Concat" or _attribute(stack, "axis") not in (1, -3) or not readers:
        return False
    if any(output.name == stacked for output in graph.output):
        return False
    levels = _levels(model, stack, made_by, weights)
    channels = sum(level.channels for level in levels)
    if not levels or not all(_is_pointwise(node, weights, channels) for node in readers):
        return False
    nodes: list[NodeProto] = []
    for node in graph.node:
        nodes.extend(_split(graph, node, levels, weights[node.input[1]]) if node in readers else [node])
    _replace(graph, nodes)
    return True


@dataclass(frozen=True)
class _Level:
    """One part of the stack.

    Attributes:
        source: name of the map, before any enlarging.
        channels: of it.
        size: (h, w) of it.
        enlarging: the node that enlarges it, None where nothing does.
        target: (h, w) that the enlarging gives.
    """

    source: str
    channels: int
    size: tuple[int, int]
    enlarging: NodeProto | None
    target: tuple[int, int]


def _levels(
    model: onnx.ModelProto, stack: NodeProto, made_by: dict[str, NodeProto], weights: dict[str, _Array]
) -> list[_Level]:
    """The parts of a stack in their order; none where a shape is not known."""
    inferred = onnx.shape_inference.infer_shapes(model).graph
    shapes = {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in inferred.value_info}
    levels = []
    for name in stack.input:
        node = made_by.get(name)
        enlarging = node if node is not None and _is_enlarging(node) else None
        source = name if enlarging is None else enlarging.input[0]
        before, after = shapes.get(source, []), shapes.get(name, [])
        if len(before) != 4 or len(after) != 4 or min(before + after) < 1:
            return []
        if before[:2] != after[:2]:  # it resizes more than height and width
            return []
        levels.append(_Level(source, before[1], (before[2], before[3]), enlarging, (after[2], after[3])))
    return levels


def _split(graph: onnx.GraphProto, reader: NodeProto, levels: list[_Level], kernel: _Array) -> list[NodeProto]:
    """The nodes that give what a convolution gives over a stack; levels of one size are summed before enlarging."""
    made: list[NodeProto] = []
    sums: dict[tuple[int, int], list[tuple[_Level, str]]] = {}
    first = 0
    for number, level in enumerate(levels):
        name = f"{reader.output[0]}/level-{number}"
        part = np.ascontiguousarray(kernel[:, first : first + level.channels])
        graph.initializer.append(numpy_helper.from_array(part, f"{name}/weight"))
        first += level.channels
        bias = list(reader.input[2:]) if number == 0 else []
        inputs = [level.source, f"{name}/weight", *bias]
        made.append(helper.make_node("Conv", inputs, [name], name=name, kernel_shape=[1, 1]))
        sums.setdefault(level.size, []).append((level, name))
    ends = []
    for size, terms in sums.items():
        total, level = _added([name for _, name in terms], made), terms[0][0]
        if level.enlarging is not None:
            shape = f"{total}/enlarged-shape"
            wanted = np.array([1, len(kernel), *level.target], np.int64)
            graph.initializer.append(numpy_helper.from_array(wanted, shape))
            enlarged = NodeProto.FromString(level.enlarging.SerializeToString())
            del enlarged.input[:], enlarged.output[:]
            enlarged.input.extend([total, "", "", shape])
            enlarged.name = f"{total}/enlarged-from-{size[0]}x{size[1]}"
            enlarged.output.append(enlarged.name)
            made.append(enlarged)
            total = enlarged.name
        ends.append(total)
    made.append(helper.make_node("Identity", [_added(ends, made)], [reader.output[0]], name=f"{reader.output[0]}/sum"))
    return made


def _added(terms: list[str], made: list[NodeProto]) -> str:
    total = terms[0]
    for term in terms[1:]:
        made.append(helper.make_node("Add", [total, term], [f"{term}/added"], name=f"{term}/added"))
        total = f"{term}/added"
    return total


def _is_enlarging(node: NodeProto) -> bool:
    """Whether a node resizes bilinearly; every way of placing the samples is linear, a region of interest aside."""
    plain = _attribute(node, "coordinate_transformation_mode") != b"tf_crop_and_resize"
    return node.op_type == "Resize" and _attribute(node, "mode") == b"linear" and plain


def _is_pointwise(node: NodeProto, weights: dict[str, _Array], channels: int) -> bool:
    """Whether a node is a plain 1×1 convolution with constant weights over all channels."""
    if node.op_type != "Conv" or node.input[1] not in weights:
        return False
    ones = all(set(_attribute(node, name) or [1]) == {1} for name in ("strides", "dilations"))
    plain = ones and _attribute(node, "group") in (None, 1) and set(_attribute(node, "pads") or [0]) == {0}
    return plain and weights[node.input[1]].shape[1:] == (channels, 1, 1)


def _attribute(node: NodeProto, name: str) -> Any:
    return next((helper.get_attribute_value(a) for a in node.attribute if a.name == name), None)


def _replace(graph: onnx.GraphProto, nodes: list[NodeProto]) -> None:
    """Set a graph's nodes, without those and the weights that nobody reads any more."""
    results = {output.name for output in graph.output}
    while True:
        read = results | {name for node in nodes for name in node.input}
        used = [node for node in nodes if read & set(node.output)]
        if len(used) == len(nodes):
            break
        nodes = used
    copies = [NodeProto.FromString(node.SerializeToString()) for node in nodes]
    del graph.node[:]
    graph.node.extend(copies)
    kept = [tensor for tensor in graph.initializer if tensor.name in read]
    weights = [onnx.TensorProto.FromString(tensor.SerializeToString()) for tensor in kept]
    del graph.initializer[:]
    graph.initializer.extend(weights)
