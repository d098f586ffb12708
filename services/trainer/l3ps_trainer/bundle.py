"""The bundle's description: what the network is fed and what its outputs mean (docs/model-bundle.md)."""

from __future__ import annotations

import json
from pathlib import Path

from l3ps.segment.bundle import InputSpec, ModelInfo

from .annotations import ClassSet
from .export import Network

BALANCED = "model-balanced.onnx"


def describe(
    network: Network,
    name: str,
    classes: ClassSet,
    boundary_threshold: float,
    balanced: InputSpec | None = None,
    note: str | None = None,
) -> dict[str, object]:
    """The content of ``model.json``.

    Args:
        network: as exported.
        name: of the model.
        classes: of the annotations; void is named only where the network knows it.
        boundary_threshold: value of the boundary map under which a pixel separates two segments.
        balanced: the input of the further graph :data:`BALANCED`, where there is one.
        note: a remark for whoever reads the file.
    """
    outputs = {output: output for output in network.outputs()}
    known = list(zip(classes.names, classes.to_nuscenes, strict=True))[network.first :]
    described: dict[str, object] = {
        "name": name,
        "label_space": "nuscenes",
        "input": network.backbone.spec.model_dump(mode="json"),
        "output": outputs | ({"boundary_threshold": boundary_threshold} if "boundary" in outputs else {}),
        "classes": [n for n, _ in known],
        "to_nuscenes": dict(known),
    }
    if balanced is not None:
        size = {"height": balanced.height, "width": balanced.width}
        described["passes"] = {"balanced": {"graph": BALANCED, **size}}
    if note is not None:
        described["note"] = note
    ModelInfo.model_validate(described)
    return described


def write_description(folder: Path, description: dict[str, object]) -> None:
    """Write ``model.json``."""
    (folder / "model.json").write_text(json.dumps(description, indent=2) + "\n")
