"""Labelled points as a bird's-eye picture: x to the right, y up, the highest point of a pixel on top.

A :class:`View` says which colour each point has and what the colours mean; :func:`birdseye` turns points and view into
pixels. Nothing here reads or writes files.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from l3ps.taxonomy import LabelSpace

Color = tuple[int, int, int]

BACKGROUND: Final[Color] = (13, 15, 19)
GRID: Final[Color] = (30, 34, 41)
TEXT: Final[Color] = (225, 228, 232)
FAINT_TEXT: Final[Color] = (140, 146, 155)
VOID: Final[Color] = (62, 66, 74)
UNNUMBERED: Final[Color] = (235, 235, 235)

_SMOOTHING: Final = 2
"""The points are drawn this many times larger and averaged down, which rounds their dots."""
_DOT: Final = 0.18
_DOT_LARGE: Final = 0.28
"""Diameters of the dots, metres; the larger one is for the highest layer."""
_PANEL: Final = 300
_MARGIN: Final = 24
_LINE: Final = 26
_DARKEST: Final = 100.0
"""Luma below which a colour is lost on the background; the usual sidewalk (75, 0, 75) has 31."""
_GOLDEN: Final = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class Entry:
    """One row of the legend.

    Attributes:
        label: what is shown.
        color: its RGB colour.
        note: a figure set at the right edge.
    """

    label: str
    color: Color
    note: str = ""


@dataclass(frozen=True, slots=True)
class View:
    """How points are coloured.

    Attributes:
        colors: (N, 3) uint8 RGB.
        layer: (N,) uint8, 0–2: points of a higher layer are not hidden by those of a lower one, whatever their
            height, and the highest is drawn a little larger.
        legend: the meaning of the colours.
    """

    colors: NDArray[np.uint8]
    layer: NDArray[np.uint8]
    legend: tuple[Entry, ...]


def class_view(semantic: NDArray[np.uint8], space: LabelSpace) -> View:
    """Every class in the colour the field is used to, lifted where it would be lost on the dark ground.

    Args:
        semantic: (N,) class indices of ``space``.
        space: the label space.
    """
    palette = _lifted(space.palette)
    palette[0] = VOID
    counts = np.bincount(semantic, minlength=len(space.classes))
    order = [int(i) for i in np.argsort(-counts, kind="stable") if counts[i]]
    order.sort(key=lambda i: i == 0)
    legend = tuple(Entry(space.classes[i], _rgb(palette[i]), _percent(counts[i], len(semantic))) for i in order)
    return View(palette[semantic], _layer(semantic != 0, space.is_thing[semantic]), legend)


def instance_view(semantic: NDArray[np.uint8], instance: NDArray[np.integer], space: LabelSpace) -> View:
    """Every object in a colour of its own, the same for the same class and id in every picture; stuff in grey.

    Args:
        semantic: (N,) class indices of ``space``.
        instance: (N,) ids, 0 = none.
        space: the label space.
    """
    things = space.is_thing[semantic]
    gray = 0.5 * (_lifted(space.palette).astype(np.float64) @ (0.299, 0.587, 0.114))
    colors = np.repeat(gray[semantic].astype(np.uint8)[:, None], 3, axis=1)
    numbered = things & (instance > 0)
    colors[things & ~numbered] = UNNUMBERED
    ids = np.stack((semantic[numbered].astype(np.int64), instance[numbered].astype(np.int64)), axis=1)
    objects, which = np.unique(ids, axis=0, return_inverse=True)
    own = distinct_colors(objects[:, 0], objects[:, 1])
    colors[numbered] = own[which.reshape(-1)]
    legend = []
    for index in sorted(set(objects[:, 0].tolist())):
        of_class = objects[:, 0] == index
        legend.append(Entry(space.classes[index], _rgb(own[of_class][0]), f"{int(of_class.sum())}"))
    if (things & ~numbered).any():
        legend.append(Entry("thing without id", UNNUMBERED))
    legend.append(Entry("stuff, void", (90, 90, 90)))
    return View(colors, _layer(semantic != 0, things), tuple(legend))


def difference_view(truth: NDArray[np.uint8], predicted: NDArray[np.uint8]) -> View:
    """Where the prediction's class is right, wrong or missing, and where there is no truth to tell.

    Args:
        truth: (N,) true class, 0 = void.
        predicted: (N,) predicted class in the same space, 0 = void.
    """
    kind = np.select([truth == 0, predicted == 0, predicted == truth], [0, 1, 2], default=3)
    names = ("no truth", "not labelled", "right", "wrong class")
    palette = np.array([VOID, (255, 190, 60), (60, 150, 110), (255, 64, 64)], dtype=np.uint8)
    counts = np.bincount(kind, minlength=4)
    judged = max(int(counts[1:].sum()), 1)
    legend = [Entry(names[i], _rgb(palette[i]), _percent(counts[i], judged)) for i in (2, 3, 1)]
    legend.append(Entry(names[0], VOID))
    return View(palette[kind], _layer(kind != 0, (kind == 1) | (kind == 3)), tuple(legend))


def distinct_colors(classes: NDArray[np.integer], ids: NDArray[np.integer]) -> NDArray[np.uint8]:
    """A vivid colour for each (class, id): a function of the pair alone, neighbouring ids far apart in hue.

    Args:
        classes: (K,) class indices.
        ids: (K,) ids.

    Returns:
        (K, 3) uint8 RGB.
    """
    hue = (np.asarray(ids) * _GOLDEN + np.asarray(classes) * 0.37) % 1.0
    level = np.asarray(ids) % 3
    hsv = np.stack((hue * 360, 0.55 + 0.2 * level, 1.0 - 0.12 * ((level + 1) % 3)), axis=1).astype(np.float32)
    if not len(hsv):
        return np.zeros((0, 3), dtype=np.uint8)
    rgb = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    return _lifted((255 * rgb).round().astype(np.uint8))


def birdseye(
    points: NDArray[np.floating],
    view: View,
    *,
    sensors: NDArray[np.floating],
    title: str,
    subtitle: str = "",
    radius: float = 50.0,
    pixels: int = 1400,
) -> NDArray[np.uint8]:
    """Draw points from above.

    Args:
        points: (N, 3) metres, x to the right and y up in the picture, z height.
        view: their colours.
        sensors: (S, 3) positions of the LiDAR in the same frame, at least one; drawn as its path.
        title: first line of the legend.
        subtitle: second line.
        radius: how far around the sensor's path to look, metres.
        pixels: length of the map's longer side.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    low, high = sensors[:, :2].min(axis=0) - radius, sensors[:, :2].max(axis=0) + radius
    scale = pixels / float((high - low).max())
    width, height = (round(float(side) * scale) for side in high - low)
    inside = ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
    frame = _Frame(low, high, scale)
    canvas = _map(frame, points[inside], view.colors[inside], view.layer[inside], (width, height))
    _draw_path(canvas, frame.pixel(sensors))
    _draw_scale_bar(canvas, scale)
    panel = _legend_panel(title, subtitle, view.legend, max(height, _MARGIN * 5 + _LINE * (len(view.legend) + 3)))
    if len(canvas) < len(panel):
        below = np.full((len(panel) - len(canvas), canvas.shape[1], 3), BACKGROUND, dtype=np.uint8)
        canvas = np.vstack((canvas, below))
    return np.hstack((canvas, panel))


@dataclass(frozen=True, slots=True)
class _Frame:
    """Where metres fall on the picture."""

    low: NDArray[np.floating]
    high: NDArray[np.floating]
    scale: float

    def pixel(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N, 2) column and row of (N, ≥2) points, not rounded."""
        return np.stack(
            ((points[:, 0] - self.low[0]) * self.scale, (self.high[1] - points[:, 1]) * self.scale), axis=1
        ).astype(np.float64)


def _map(
    frame: _Frame,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    layer: NDArray[np.uint8],
    size: tuple[int, int],
) -> NDArray[np.uint8]:
    """Grid and points. A dot is a dilated pixel of rank numbers, so that the upper of two dots hides the lower one."""
    width, height = size[0] * _SMOOTHING, size[1] * _SMOOTHING
    canvas = np.empty((height, width, 3), dtype=np.uint8)
    canvas[:] = BACKGROUND
    fine = _Frame(frame.low, frame.high, frame.scale * _SMOOTHING)
    for axis in (0, 1):
        for metre in np.arange(np.ceil(frame.low[axis] / 10) * 10, frame.high[axis], 10):
            at = int(fine.pixel(np.array([[metre, metre]]))[0, axis])
            if axis == 0:
                canvas[:, max(at, 0) : at + _SMOOTHING] = GRID
            else:
                canvas[max(at, 0) : at + _SMOOTHING] = GRID
    order = np.lexsort((points[:, 2], layer))
    column, row = np.clip(fine.pixel(points[order]).astype(np.int64), 0, (width - 1, height - 1)).T
    rank = np.zeros((height, width), dtype=np.float32)  # exact up to 2**24 points
    rank[row, column] = np.arange(1, len(order) + 1)
    upper = np.where(rank > np.count_nonzero(layer < 2), rank, 0)
    rank = np.maximum(_grown(rank, _DOT * fine.scale), _grown(upper, _DOT_LARGE * fine.scale))
    hit = rank > 0
    canvas[hit] = colors[order[rank[hit].astype(np.int64) - 1]]
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _grown(rank: NDArray[np.float32], diameter: float) -> NDArray[np.float32]:
    """Each pixel with a rank grown to a disc of at least 5 fine pixels across; the higher rank wins."""
    size = max(5, round(diameter) | 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(rank, disc), dtype=np.float32)


def _draw_path(canvas: NDArray[np.uint8], path: NDArray[np.float64]) -> None:
    """The sensor's path, with a ring at its start."""
    pixels = path.round().astype(np.int32)
    cv2.polylines(canvas, [pixels[:, None]], False, (255, 255, 255), 1, cv2.LINE_AA)
    for x, y in pixels.tolist():
        cv2.circle(canvas, (x, y), 2, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(canvas, pixels[0].tolist(), 7, (255, 255, 255), 1, cv2.LINE_AA)


def _draw_scale_bar(canvas: NDArray[np.uint8], scale: float) -> None:
    """A bar of a round number of metres at the lower left, at most a fifth of the width."""
    room = canvas.shape[1] / 5 / scale
    power = 10.0 ** np.floor(np.log10(room))
    metres = max(step * power for step in (1, 2, 5) if step * power <= room)
    x, y, end = _MARGIN, len(canvas) - _MARGIN, _MARGIN + round(metres * scale)
    cv2.rectangle(canvas, (x - 10, y - 34), (end + 10, y + 12), BACKGROUND, -1)
    cv2.line(canvas, (x, y), (end, y), TEXT, 2, cv2.LINE_AA)
    for tick in (x, end):
        cv2.line(canvas, (tick, y - 5), (tick, y + 5), TEXT, 2, cv2.LINE_AA)
    _write(canvas, f"{metres:g} m", (x, y - 12), 0.55, TEXT)


def _legend_panel(title: str, subtitle: str, legend: tuple[Entry, ...], height: int) -> NDArray[np.uint8]:
    """The column at the right: title, subtitle, one row an entry."""
    panel = np.empty((height, _PANEL, 3), dtype=np.uint8)
    panel[:] = BACKGROUND
    y = _MARGIN + 14
    for text, size, color in ((title, 0.6, TEXT), (subtitle, 0.45, FAINT_TEXT)):
        for line in text.splitlines():
            _write(panel, line, (4, y), size, color)
            y += _LINE - 2
    y += 12
    for entry in legend:
        cv2.circle(panel, (13, y - 5), 7, entry.color, -1, cv2.LINE_AA)
        _write(panel, entry.label, (32, y), 0.5, TEXT)
        (length, _), _ = cv2.getTextSize(entry.note, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        _write(panel, entry.note, (_PANEL - _MARGIN - length, y), 0.45, FAINT_TEXT)
        y += _LINE
    return panel


def _write(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], size: float, color: Color) -> None:
    """Text that fits into the canvas; the font has ASCII only."""
    text = text.encode("ascii", "replace").decode()
    (length, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    size *= min(1.0, (canvas.shape[1] - at[0] - 4) / max(length, 1))
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)


def _layer(present: NDArray[np.bool_], important: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Layers from what is there at all and what matters most."""
    return present.astype(np.uint8) + important.astype(np.uint8)


def _lifted(palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The colours mixed with as much white as brings them to the least luma that shows."""
    rgb = palette.astype(np.float64)
    luma = rgb @ (0.299, 0.587, 0.114)
    share = np.clip((_DARKEST - luma) / (255 - luma), 0, 1)[:, None]
    return (rgb + share * (255 - rgb)).round().astype(np.uint8)


def _rgb(color: NDArray[np.uint8]) -> Color:
    red, green, blue = color.tolist()
    return red, green, blue


def _percent(part: np.integer | int, whole: int) -> str:
    return f"{100 * int(part) / max(whole, 1):.1f} %"
