"""Panoptic quality and IoU under the three protocols."""

from l3ps.evaluate.drive import evaluate_drive, evaluate_scene
from l3ps.evaluate.estimates import ScanEstimate, estimate_scans, rank_correlation, seen_twice
from l3ps.evaluate.evaluator import PanopticEvaluator
from l3ps.evaluate.protocols import PROTOCOLS, Protocol, protocol_named
from l3ps.evaluate.quality import ClassQuality, Quality

__all__ = [
    "PROTOCOLS",
    "ClassQuality",
    "PanopticEvaluator",
    "Protocol",
    "Quality",
    "ScanEstimate",
    "estimate_scans",
    "evaluate_drive",
    "evaluate_scene",
    "protocol_named",
    "rank_correlation",
    "seen_twice",
]
