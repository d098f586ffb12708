"""The three named ways of measuring; a figure without its protocol's name means nothing."""

from __future__ import annotations

from dataclasses import dataclass

from l3ps.taxonomy import NUSCENES16, SEMANTICKITTI19, LabelSpace


@dataclass(frozen=True, slots=True)
class Protocol:
    """What counts as a segment and which points are left out.

    Attributes:
        name: how the protocol is named beside every figure.
        space: label space in which truth and prediction are compared.
        min_points: smaller segments are no false positives and no false negatives; matched ones still count.
        ignore_predicted_void: also leave out points void in the prediction, which flatters a method that abstains.
        summary: one clause for tables and help texts.
    """

    name: str
    space: LabelSpace
    min_points: int
    ignore_predicted_void: bool
    summary: str


PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            name="nuscenes",
            space=NUSCENES16,
            min_points=15,
            ignore_predicted_void=False,
            summary="official Panoptic nuScenes: segments of 15 points and more, only truth void left out",
        ),
        Protocol(
            name="paper",
            space=NUSCENES16,
            min_points=30,
            ignore_predicted_void=True,
            summary="as in the paper: segments of 30 points and more, points void in the prediction left out too",
        ),
        Protocol(
            name="semantickitti",
            space=SEMANTICKITTI19,
            min_points=50,
            ignore_predicted_void=False,
            summary="official SemanticKITTI: segments of 50 points and more, 19 classes, only truth void left out",
        ),
    )
}
"""Protocols by name. Sources: nuscenes-devkit 1.2.0 ``nuscenes.eval.panoptic.evaluate`` (min_inst_points 15);
L3PS section IV (30); semantic-kitti-api ``evaluate_panoptic.py`` (min_inst_points 50, class 0 ignored)."""


def protocol_named(name: str) -> Protocol:
    """The protocol of that name.

    Raises:
        ValueError: the name is none of the three.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"unknown protocol {name!r}: choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
