"""The authors' published checkpoints as a bundle: two Lightning files, one for each head, into one graph.

Each file is a pickle, of which nothing but tensors and plain values is read: no code in it runs. Its ``state_dict``
holds ``encoder.…`` in DINOv2's own naming and ``head.…``, a sequence of 1×1 convolutions (PASTEL, METHOD 1). Both heads
were trained on the same frozen encoder, so the bundle runs it once; files whose encoders differ are refused, because
running two would double the cost for weights that frozen training cannot have changed.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from l3ps.errors import ModelError, Problem

from .annotations import NUSCENES_AND_SKY, ClassSet
from .annotations.classes import read_classes
from .backbones import VARIANTS, DinoV2
from .backbones.dinov2 import PATCH
from .bundle import describe, write_description
from .export import Agreement, Network, agreement, write_graph
from .heads import Heads, Pointwise, quarter
from .recipe import PUBLISHED

ENCODER, HEAD = "encoder.", "head."
_CONVOLUTION = re.compile(r"(?:.*\.)?(\d+)\.weight")
_LETTERS = {384: "s", 768: "b", 1024: "l", 1536: "g"}
"""Width of a DINOv2 → its letter."""
_REMEDY = "Name the authors' Lightning checkpoints: first the semantic one, then the boundary one."


def pastel_network(
    semantic: Path, boundary: Path, classes: ClassSet, size: tuple[int, int], **architecture: Any
) -> Network:
    """The network of two checkpoints.

    Args:
        semantic: checkpoint of the semantic head.
        boundary: checkpoint of the boundary head.
        classes: what the semantic head's channels mean, void included.
        size: (height, width) of the input, multiples of 14.
        architecture: what differs from the published encoder, for tests (``depth=2``).

    Raises:
        ModelError: with what is wrong with which file.
    """
    one, other = _state(semantic), _state(boundary)
    encoder = _part(one, ENCODER, semantic)
    _same_encoder(encoder, _part(other, ENCODER, boundary), boundary)
    backbone = DinoV2(_variant(encoder, semantic), encoder, size, **architecture)
    heads = Heads(
        _head(_part(one, HEAD, semantic), backbone.channels, len(classes), PATCH, semantic),
        _head(_part(other, HEAD, boundary), backbone.channels, 1, quarter(PATCH), boundary),
    )
    return Network(backbone, heads, keep_void=True)


def import_checkpoints(
    semantic: Path, boundary: Path, out: Path, name: str, size: tuple[int, int], classes: Path | None, threads: int
) -> Agreement:
    """Write the bundle of two checkpoints.

    Args:
        semantic: checkpoint of the semantic head.
        boundary: checkpoint of the boundary head.
        out: the bundle's folder; made when missing.
        name: of the model.
        size: (height, width) of the input, multiples of 14.
        classes: classes file in the order of the head's channels after void; None for nuScenes' sixteen and sky.
        threads: of ONNX Runtime, for the comparison.

    Returns:
        How far torch and ONNX Runtime agree on a random picture.

    Raises:
        InputError: with what is wrong with which file.
        ProcessingError: the runtimes differ by more than rounding.
    """
    known = NUSCENES_AND_SKY if classes is None else read_classes(classes).classes
    network = pastel_network(semantic, boundary, known, size)
    graph = out / "model.onnx"
    write_graph(network, graph)
    noise = torch.randn((1, 3, *size), generator=torch.Generator().manual_seed(0))
    agreed = agreement(network, graph, [noise.numpy()], threads)
    write_description(out, describe(network, name, known, PUBLISHED.boundary_threshold))
    return agreed


def _state(path: Path) -> dict[str, Tensor]:
    """The ``state_dict`` of a Lightning checkpoint."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise _wrong(path, "there is no such file") from error
    except pickle.UnpicklingError as error:
        what = "it holds more than tensors and plain values, and unpickling that could run its code"
        remedy = (
            "Where you trust the file, keep only what is needed: torch.save({'state_dict': content['state_dict']})."
        )
        raise ModelError(Problem("bad-checkpoint", str(path), what, remedy)) from error
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        raise _wrong(path, "it is no torch checkpoint, or it is cut short") from error
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise _wrong(path, "it has no state_dict of tensors")
    return state


def _part(state: Mapping[str, Tensor], prefix: str, path: Path) -> dict[str, Tensor]:
    part = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    if not part:
        known = ", ".join(sorted({name.split(".")[0] for name in state})[:6]) or "nothing"
        raise _wrong(path, f"no key of its state_dict begins with '{prefix}' (it has {known})")
    return part


def _same_encoder(one: Mapping[str, Tensor], other: Mapping[str, Tensor], path: Path) -> None:
    different = sorted(one.keys() ^ other.keys())
    different += [n for n, value in one.items() if n in other and not torch.equal(value, other[n])]
    if different:
        what = f"its encoder is not the semantic checkpoint's ({len(different)} tensors differ, {different[0]} first)"
        remedy = "Both heads must come from one frozen encoder; take two checkpoints of the same backbone."
        raise ModelError(Problem("different-encoders", str(path), what, remedy))


def _variant(encoder: Mapping[str, Tensor], path: Path) -> str:
    width = encoder["cls_token"].shape[-1] if "cls_token" in encoder else 0
    if width not in _LETTERS:
        raise _wrong(path, f"its encoder is no DINOv2 (class token of width {width})")
    name = f"dinov2-{_LETTERS[width]}{'-reg' if 'register_tokens' in encoder else ''}"
    if name not in VARIANTS:
        raise _wrong(path, f"there is no {name}")
    return name


def _head(part: Mapping[str, Tensor], channels: int, outputs: int, enlargement: int, path: Path) -> Pointwise:
    """A head from the convolutions of a sequence, in the order of their numbers."""
    numbered = {}
    for name, value in part.items():
        match = _CONVOLUTION.fullmatch(name)
        if match and value.ndim == 4:
            numbered[int(match[1])] = name.removesuffix("weight")
    layers = [numbered[number] for number in sorted(numbered)]
    shapes = [tuple(part[f"{layer}weight"].shape) for layer in layers]
    widths = [channels, *(shape[0] for shape in shapes)]
    expected = [(b, a, 1, 1) for a, b in pairwise(widths)]
    biased = all(f"{layer}bias" in part for layer in layers)
    if len(layers) < 2 or shapes != expected or not biased or len(part) != 2 * len(layers):
        found = ", ".join("×".join(map(str, value.shape)) for value in part.values())
        raise _wrong(path, f"its head is no sequence of 1×1 convolutions with biases on {channels} channels ({found})")
    if widths[-1] != outputs:
        meant = "classes (void included)" if outputs > 1 else "boundary channel"
        raise _wrong(path, f"its head ends in {widths[-1]} channels where {outputs} {meant} were expected")
    head = Pointwise(channels, widths[1:-1], outputs, enlargement, quarter(PATCH))
    head.load_state_dict(
        {
            f"layers.{position}.{kind}": part[layer + kind]
            for position, layer in enumerate(layers)
            for kind in ("weight", "bias")
        }
    )
    return head


def _wrong(path: Path, what: str) -> ModelError:
    return ModelError(Problem("bad-checkpoint", str(path), what, _REMEDY))
