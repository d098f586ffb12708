"""Panoptic quality and IoU under the three protocols."""

from l3ps.evaluate.drive import evaluate_drive, evaluate_scene
from l3ps.evaluate.evaluator import PanopticEvaluator
from l3ps.evaluate.protocols import PROTOCOLS, Protocol, protocol_named
from l3ps.evaluate.quality import ClassQuality, Quality
from l3ps.evaluate.tracking import IdConsistency, id_consistency

__all__ = [
    "PROTOCOLS",
    "ClassQuality",
    "IdConsistency",
    "PanopticEvaluator",
    "Protocol",
    "Quality",
    "evaluate_drive",
    "evaluate_scene",
    "id_consistency",
    "protocol_named",
]
