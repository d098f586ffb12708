"""Bundles with random weights: as fast as the trained ones, and good for nothing else."""

from __future__ import annotations

from pathlib import Path

import torch

from .annotations import NUSCENES_AND_SKY
from .backbones import DinoV2
from .bundle import describe, write_description
from .export import Network, write_graph
from .heads import HEADS
from .quantise import quantise

NOTE = "random weights: for measuring speed only, its labels mean nothing"


def write_speed_bundle(folder: Path, backbone: str, size: tuple[int, int], heads: str, *, int8: bool) -> Path:
    """Write a bundle of a network that was never trained.

    Args:
        folder: where to; made when missing.
        backbone: a DINOv2 by name.
        size: (height, width) of the input.
        heads: by name.
        int8: with quantised products.

    Returns:
        The graph's path.
    """
    torch.manual_seed(0)
    network = DinoV2(backbone, None, size)
    made = HEADS[heads](network.channels, len(NUSCENES_AND_SKY), boundary=True, stride=network.stride)
    whole = Network(network, made)
    graph = folder / "model.onnx"
    write_graph(whole, graph)
    if int8:
        quantise(graph, graph)
    name = f"random-weights-{backbone}{'-int8' if int8 else ''}"
    write_description(folder, describe(whole, name, NUSCENES_AND_SKY, 0.5, note=NOTE))
    return graph
