"""The report of a training: report.json for programs, report.md for people."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from .validation import Confusion


def scores(confusion: Confusion, names: tuple[str, ...], images: int) -> dict[str, Any]:
    """Validation as plain data: per cent, None for classes that the validation images never show."""
    iou = {name: _number(value) for name, value in zip(names[1:], confusion.iou()[1:], strict=True)}
    return {"images": images, "miou": _number(confusion.miou()), "classes": iou}


def write(folder: Path, report: dict[str, Any]) -> None:
    """Write both files."""
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    (folder / "report.md").write_text(_page(report))


def _page(report: dict[str, Any]) -> str:
    agreement, seconds, size = report["agreement"], report["seconds"], report["input"]
    spent = ", ".join(f"{step} {value:.0f} s" for step, value in seconds.items())
    lines = [
        f"# {report['name']}",
        "",
        f"- {report['images']} annotated images, backbone {report['backbone']}, recipe {report['recipe']}",
        f"- input {size['height']}x{size['width']}, {report['steps']} steps on {report['device']}",
        f"- {spent}",
        f"- torch and ONNX Runtime: probabilities differ by at most {agreement['probability']:.1e}, "
        f"{100 * agreement['equal']:.3f} % of the pixels get the same class",
    ]
    if report["never_occur"]:
        lines.append(f"- never seen in training, so never found: {', '.join(report['never_occur'])}")
    if report["int8"] is not None:
        kept = "kept" if report["int8"]["kept"] else "dropped, it costs too much"
        lines.append(f"- int8: mIoU {report['int8']['miou']:.1f} beside {report['int8']['float_miou']:.1f}; {kept}")
    validation = report["validation"]
    if validation is None:
        return "\n".join([*lines, "- no validation images were given, so how good it is remains unknown", ""])
    rows = [f"| {name} | {'–' if v is None else f'{v:.1f}'} |" for name, v in validation["classes"].items()]
    mean = "–" if validation["miou"] is None else f"{validation['miou']:.1f}"
    lines += ["", f"IoU in per cent on {validation['images']} images kept apart from training:", ""]
    return "\n".join([*lines, "| class | IoU |", "|---|---|", *rows, f"| mean | {mean} |", ""])


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 2)
