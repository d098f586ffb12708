"""Class names that are known, and where they belong among the sixteen classes: the one place for all formats.

Sources: nuScenes lidarseg challenge definition (through :mod:`l3ps.taxonomy`), Cityscapes' and COCO panoptic's own
category lists. Where nuScenes' instructions name a thing, they decide: rails, water and low steps are other flat
ground, riders belong to what they ride (most of Cityscapes' to a bicycle).
"""

from __future__ import annotations

from typing import Final

from l3ps.taxonomy import NUSCENES16, NUSCENES_RAW_TO_16

from .types import ClassSet

SKY: Final = "sky"
_TARGETS: Final = {name: index for index, name in enumerate(NUSCENES16.classes)}

CITYSCAPES_IDS: Final[dict[int, tuple[str, str]]] = {
    7: ("road", "driveable_surface"),
    8: ("sidewalk", "sidewalk"),
    11: ("building", "manmade"),
    12: ("wall", "manmade"),
    13: ("fence", "manmade"),
    17: ("pole", "manmade"),
    19: ("traffic light", "manmade"),
    20: ("traffic sign", "manmade"),
    21: ("vegetation", "vegetation"),
    22: ("terrain", "terrain"),
    23: (SKY, "void"),
    24: ("person", "pedestrian"),
    25: ("rider", "bicycle"),
    26: ("car", "car"),
    27: ("truck", "truck"),
    28: ("bus", "bus"),
    31: ("train", "void"),
    32: ("motorcycle", "motorcycle"),
    33: ("bicycle", "bicycle"),
}
"""Cityscapes label id → the name of its training class and the class of nuScenes."""
CITYSCAPES_VOID: Final = frozenset({*range(34), 255}) - CITYSCAPES_IDS.keys()
"""Label ids that Cityscapes leaves out of training; 255 is its -1, a licence plate, in a byte."""

_COCO: Final[dict[str, str]] = {
    "pedestrian": "person",
    "driveable_surface": "road",
    "sidewalk": "pavement-merged",
    "terrain": "grass-merged dirt-merged sand gravel snow playingfield mountain-merged rock-merged",
    "other_flat": "railroad platform river sea water-other",
    "vegetation": "tree-merged flower",
    "manmade": """bridge building-other-merged house roof tent wall-brick wall-stone wall-tile wall-wood
        wall-other-merged fence-merged stairs banner net traffic_light fire_hydrant stop_sign parking_meter bench""",
    SKY: "sky-other-merged",
    "void": """train airplane boat bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag
        tie suitcase frisbee skis snowboard sports_ball kite baseball_bat baseball_glove skateboard surfboard
        tennis_racket bottle wine_glass cup fork knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog
        pizza donut cake chair couch potted_plant bed dining_table toilet tv laptop mouse remote keyboard cell_phone
        microwave oven toaster sink refrigerator book clock vase scissors teddy_bear hair_drier toothbrush blanket
        cardboard counter curtain door-stuff floor-wood fruit light mirror-stuff pillow shelf towel window-blind
        window-other ceiling-merged cabinet-merged table-merged floor-other-merged paper-merged food-other-merged
        rug-merged""",
}
"""nuScenes class → COCO's categories that belong to it, beyond those of the same name."""
_COMMON: Final[dict[str, str]] = {
    "pedestrian": "pedestrians people",
    "bicycle": "bicyclist cyclist",
    "motorcycle": "motorcyclist motorbike",
    "traffic_cone": "cone trafficcone",
    "construction_vehicle": "excavator",
    "driveable_surface": "drivable_surface parking lane_marking road_marking",
    "sidewalk": "pavement",
    "terrain": "grass ground",
    "other_flat": "rail_track other_ground",
    "vegetation": "tree trees trunk bush",
    "manmade": """pole polegroup column_pole sign sign_symbol traffic_sign building wall fence guard_rail tunnel""",
    "void": "unlabeled unlabelled unknown ignore ego_vehicle caravan other_vehicle",
}
"""nuScenes class → names that other data sets and people use for it."""


def _plain(name: str) -> str:
    """A name without what people write differently: case, spaces and hyphens."""
    return name.strip().lower().replace(" ", "_").replace("-", "_")


def _known() -> dict[str, str]:
    table = {_plain(raw): NUSCENES16.classes[index] for raw, index in NUSCENES_RAW_TO_16.items()}
    for target, names in (*_COCO.items(), *_COMMON.items()):
        table.update({_plain(name): target for name in names.split()})
    table.update({_plain(name): target for name, target in CITYSCAPES_IDS.values()})
    table.update({name: name for name in (*NUSCENES16.classes, SKY)})
    return table | {SKY: SKY}


_KNOWN: Final = _known()


def known_class(name: str) -> str | None:
    """The class of :data:`~.types.NUSCENES_AND_SKY` that a name of some data set means; None where it is not known."""
    return _KNOWN.get(_plain(name))


def nuscenes_class(value: object) -> int | None:
    """The ``NUSCENES16`` number of a class named or numbered in a file; None for anything else."""
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(NUSCENES16.classes):
        return value
    return _TARGETS.get(_plain(value)) if isinstance(value, str) else None


CITYSCAPES: Final = ClassSet(
    ("void", *(name for name, _ in CITYSCAPES_IDS.values())),
    (0, *(_TARGETS[target] for _, target in CITYSCAPES_IDS.values())),
)
"""Void and the nineteen training classes of Cityscapes."""
