"""What is in a bundle's graph, and what must not be: read with ``onnx``, nothing run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import onnx

from l3ps.errors import Problem, first_line
from l3ps.segment.bundle import InputSpec, ModelBundle

MAX_NODES = 50_000
"""A ViT-g exports to 3,000."""
MAX_DEPTH = 2
"""Graphs within graphs (branches and loops); an exported segmenter has none."""
MAX_ELEMENTS = 1 << 31
"""Of one tensor that a graph declares."""

STANDARD = frozenset({"", "ai.onnx", "ai.onnx.ml"})
RUNTIME_DOMAIN = "com.microsoft"
RUNTIME_OPERATORS = frozenset(
    {"DynamicQuantizeMatMul", "MatMulIntegerToFloat", "FusedMatMul", "Gelu", "QuickGelu", "MultiHeadAttention"}
)
"""Operators of onnxruntime's own: what its quantisation and graph optimisation write, and the attention of our ViTs."""
_INT8 = frozenset({"MatMulInteger", "ConvInteger", "QLinearMatMul", "QLinearConv", "DequantizeLinear"})
_INT8_OPERATORS = _INT8 | {"DynamicQuantizeMatMul", "MatMulIntegerToFloat"}


@dataclass
class Look:
    """What was seen in a graph.

    Attributes:
        facts: fields of a :class:`l3ps.segment.check.GraphReport`.
        problems: reasons to refuse it.
    """

    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)


def look(bundle: ModelBundle, preset: str) -> Look:
    """Read the graph of a segmentation preset."""
    data, spec = bundle.graph_for(preset)
    file = bundle.info.passes[preset].graph if preset in bundle.info.passes else "model.onnx"
    seen = Look({"preset": preset, "file": file, "bytes": len(data), "input": [1, 3, spec.height, spec.width]})

    def refuse(code: str, what: str, remedy: str = "Export the model again, or correct model.json.") -> None:
        seen.problems.append(Problem(code, f"model '{bundle.info.name}'/{file}", what, remedy))

    try:
        model = onnx.ModelProto.FromString(data)
    except MemoryError:
        raise
    except Exception as error:  # protobuf's own, which onnx does not export
        refuse("bad-graph", f"it is no ONNX graph ({first_line(error)})")
        return seen
    if not model.graph.node:
        refuse("bad-graph", "it holds no operators")
        return seen
    if model.functions:
        refuse("custom-operator", f"it defines {len(model.functions)} functions of its own", "Export it without them.")
    nodes, depth = _count(model.graph)
    if nodes > MAX_NODES or depth > MAX_DEPTH:
        what = f"it has {nodes} operators, nested {depth} deep; {MAX_NODES} and {MAX_DEPTH} are allowed"
        refuse("model-too-large", what)
        return seen
    for what in _foreign(model):
        refuse("custom-operator", what, "Export it with standard ONNX operators only.")
    for what in _absurd(model.graph):
        refuse("model-too-large", what)
    for what in _mismatch(model.graph, bundle, spec):
        refuse("bad-graph", what)
    operators = {node.op_type for graph in _graphs(model.graph) for node in graph.node}
    opset = max((o.version for o in model.opset_import if o.domain in {"", "ai.onnx"}), default=0)
    seen.facts |= {"opset": opset, "nodes": nodes, "int8": bool(operators & _INT8_OPERATORS)}
    return seen


def _inner(graph: onnx.GraphProto) -> Iterator[onnx.GraphProto]:
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield attribute.g
            yield from attribute.graphs


def _graphs(graph: onnx.GraphProto) -> Iterator[onnx.GraphProto]:
    """A graph and all within it."""
    stack = [graph]
    while stack:
        one = stack.pop()
        yield one
        stack += _inner(one)


def _count(graph: onnx.GraphProto) -> tuple[int, int]:
    """Operators of a graph and all within it, and how deep they nest; counting ends where either is too much."""
    nodes, deepest, stack = 0, 0, [(graph, 0)]
    while stack and nodes <= MAX_NODES and deepest <= MAX_DEPTH:
        one, depth = stack.pop()
        nodes += len(one.node)
        deepest = max(deepest, depth)
        if nodes <= MAX_NODES:
            stack += [(inner, depth + 1) for inner in _inner(one)]
    return nodes, deepest


def _foreign(model: onnx.ModelProto) -> list[str]:
    """Operators that only foreign code could run."""
    used = {(node.domain, node.op_type) for graph in _graphs(model.graph) for node in graph.node}
    foreign = sorted(
        f"{domain}.{operator}"
        for domain, operator in used
        if domain not in STANDARD and not (domain == RUNTIME_DOMAIN and operator in RUNTIME_OPERATORS)
    )
    return [f"it uses the custom operators {', '.join(foreign[:5])}"[:300]] if foreign else []


def _absurd(graph: onnx.GraphProto) -> list[str]:
    """Tensors that are declared larger than any segmenter's, or of a size that is none."""
    found = []
    for one in _graphs(graph):
        declared = [(t.name, list(t.dims)) for t in one.initializer]
        declared += [(a.t.name or n.name, list(a.t.dims)) for n in one.node for a in n.attribute if a.HasField("t")]
        declared += [(v.name, _shape(v)) for v in (*one.input, *one.output, *one.value_info)]
        for name, dims in declared:
            sizes = [d for d in dims if isinstance(d, int)]
            if len(dims) > 16 or any(d < 0 for d in sizes) or math.prod(sizes) > MAX_ELEMENTS:
                found.append(f"tensor '{name[:100]}' is declared as {str(dims)[:100]}")
    return found[:5]


def _mismatch(graph: onnx.GraphProto, bundle: ModelBundle, spec: InputSpec) -> list[str]:
    """Where inputs and outputs are not those of ``model.json``."""
    info, found = bundle.info, []
    constants = {t.name for t in graph.initializer}
    inputs = {v.name: v for v in graph.input if v.name not in constants}
    outputs = {v.name: v for v in graph.output}
    wanted: list[tuple[str, str, dict[str, onnx.ValueInfoProto], list[int | None]]] = [
        ("input", info.input.name, inputs, [1, 3, spec.height, spec.width]),
        ("output", info.output.semantic, outputs, [1, len(info.classes), None, None]),
    ]
    if info.output.boundary:
        wanted.append(("output", info.output.boundary, outputs, [1, 1, None, None]))
    for kind, name, values, shape in wanted:
        if name not in values:
            found.append(f"the graph has no {kind} '{name}' (it has {', '.join(sorted(values))[:200]})")
            continue
        tensor = values[name].type.tensor_type
        if tensor.elem_type not in {onnx.TensorProto.FLOAT, onnx.TensorProto.UNDEFINED}:
            found.append(f"{kind} '{name}' is of type {tensor.elem_type}, not float32 (1)")
        if tensor.HasField("shape"):
            dims = _shape(values[name])
            same = (not isinstance(d, int) or w is None or d == w for d, w in zip(dims, shape, strict=False))
            if len(dims) != 4 or not all(same):
                said = [w if w is not None else "any" for w in shape]
                found.append(f"{kind} '{name}' has the shape {dims}, model.json says {said}")
    if extra := sorted(set(inputs) - {info.input.name}):
        found.append(f"the graph wants further inputs ({', '.join(extra)[:200]})")
    if len(set(info.classes)) < len(info.classes):
        found.append("model.json names a class twice")
    if not info.lut.any():
        found.append("model.json maps every class to void")
    return found


def _shape(value: onnx.ValueInfoProto) -> list[int | str]:
    dims = value.type.tensor_type.shape.dim
    return [d.dim_value if d.HasField("dim_value") else d.dim_param or "?" for d in dims]
