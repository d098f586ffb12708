"""Panoptic quality and IoU under the three protocols."""

from l3ps.evaluate.drive import evaluate_drive, evaluate_scene, follow_ids
from l3ps.evaluate.estimates import ScanEstimate, estimate_scans, mean_estimates, rank_correlation, seen_twice
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
    "ScanEstimate",
    "estimate_scans",
    "evaluate_drive",
    "evaluate_scene",
    "follow_ids",
    "id_consistency",
    "mean_estimates",
    "protocol_named",
    "rank_correlation",
    "seen_twice",
]
