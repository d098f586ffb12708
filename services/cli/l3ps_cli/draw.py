"""``l3ps draw``: labels as a bird's-eye picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from l3ps.draw import View, birdseye, class_view, difference_view, instance_view
from l3ps.drivelog import opened
from l3ps.drivelog.types import Drive, Scan, Scene
from l3ps.errors import InputError, LabelError, Problem
from l3ps.labels import LabelFolder, open_labels, read_poses
from l3ps.labels.files import write_whole
from l3ps.labels.reader import wrong_count
from l3ps.labels.spaces import SPACES, convert
from l3ps.taxonomy import NUSCENES16
from l3ps_cli.errors import clear_errors, out

Coloring = Literal["class", "instance", "truth", "truth-instance", "difference"]
Panoptic = tuple[NDArray[np.uint8], NDArray[np.int64]]


def draw(
    log: Annotated[Path, typer.Argument(help="Drive log: a directory or archive of any supported format.")],
    output: Annotated[Path, typer.Option("--out", help="The picture to write (.png or .jpg).")],
    labels: Annotated[Path | None, typer.Option(help="Folder of label files; not needed to draw truth.")] = None,
    by: Annotated[Coloring, typer.Option(help="What the colours show.")] = "class",
    scene: Annotated[str | None, typer.Option(help="This scene in place of the first.")] = None,
    scan: Annotated[int, typer.Option(min=0, help="Which scan of the scene, from 0.")] = 0,
    whole_scene: Annotated[bool, typer.Option("--whole-scene", help="All scans of the scene, accumulated.")] = False,
    poses: Annotated[
        Path | None,
        typer.Option(help="Folder of poses.txt; default: the labels' or the one above, else the log's own."),
    ] = None,
    radius: Annotated[float, typer.Option(min=1, max=500, help="How far around the sensor to look, metres.")] = 50.0,
    pixels: Annotated[int, typer.Option(min=200, max=8000, help="Length of the map's longer side.")] = 1400,
) -> None:
    """Draw a scan, or a whole scene, from above, coloured by class, instance, truth or the difference to it."""
    with clear_errors():
        if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise _bad("picture-format", "--out", f"'{output.name}' is no .png or .jpg", "Name the picture so.")
        if labels is None and by in ("class", "instance", "difference"):
            raise _bad(
                "no-labels", "--labels", f"drawing by {by} needs labels", "Name their folder, or use --by truth."
            )
        folder = open_labels(labels) if labels is not None else None
        with opened(log) as drive:
            chosen = _scene(drive, scene)
            source = _Source(drive, chosen, folder, by)
            scans = source.drawable(chosen.scans if whole_scene else (_scan(chosen, scan),))
            places = _places(chosen, scans, poses, labels) if whole_scene else [np.eye(4)]
            clouds, parts = [], []
            for one, place in zip(scans, places, strict=True):
                xyz = one.load_points().xyz
                clouds.append(xyz.astype(np.float64) @ place[:3, :3].T + place[:3, 3])
                parts.append(source.read(one, len(xyz)))
        which = f"{len(scans)} scan{'s' * (len(scans) != 1)}" if whole_scene else f"scan {scan} ({scans[0].token})"
        image = birdseye(
            np.concatenate(clouds),
            source.view([np.concatenate(columns) for columns in zip(*parts, strict=True)]),
            sensors=np.stack(places)[:, :3, 3],
            title=f"{log.resolve().name} {chosen.name}",
            subtitle=f"{which}\ncoloured by {by}" + (f"\n{_short(labels)}" if labels is not None else ""),
            radius=radius,
            pixels=pixels,
        )
        _, encoded = cv2.imencode(output.suffix.lower(), image[:, :, ::-1])
        try:
            write_whole(output, encoded.tobytes())
        except OSError as error:
            raise _bad(
                "bad-output", str(output), f"cannot be written ({error.strerror})", "Name another file."
            ) from error
    out.print(f"{output}: {image.shape[1]}×{image.shape[0]} pixels, {which}", highlight=False)


@dataclass(frozen=True, slots=True)
class _Source:
    """Where the colours of a scene's points come from.

    The difference is drawn in the 16 classes, which labels and truth of every log share; labels and truth by themselves
    in the classes they come in.
    """

    drive: Drive
    scene: Scene
    labels: LabelFolder | None
    by: Coloring

    @property
    def needs_truth(self) -> bool:
        return self.by in ("truth", "truth-instance", "difference")

    @property
    def space(self) -> str:
        if self.by == "difference" or self.labels is None:
            return NUSCENES16.name if self.by == "difference" else self.drive.truth_space
        return self.drive.truth_space if self.needs_truth else self.labels.format

    def drawable(self, scans: tuple[Scan, ...]) -> list[Scan]:
        """The scans that have what is to be drawn; InputError where none has."""
        found = list(scans)
        if self.needs_truth:
            found = [scan for scan in found if scan.load_truth is not None]
            if not found:
                raise _bad("no-truth", f"scene {self.scene.name}", "has no truth to draw", "Draw --by class instead.")
        if self.labels is not None and self.by not in ("truth", "truth-instance"):
            labelled = [scan for scan in found if self.labels.find(self.scene, scan) is not None]
            if not labelled:
                raise LabelError(self.labels.missing(self.scene, found[0]))
            found = labelled
        return found

    def read(self, scan: Scan, points: int) -> list[NDArray[np.integer]]:
        """Columns of the scan's labels, each (N,): what :meth:`view` takes once the scans are joined."""
        columns: list[NDArray[np.integer]] = []
        if self.needs_truth and scan.load_truth is not None:
            truth = scan.load_truth()
            columns += convert(truth.semantic, truth.instance, self.drive.truth_space, self.space)
        if self.labels is not None and self.by not in ("truth", "truth-instance"):
            columns += self.labels.read(self.scene, scan, self.space)
        for column in columns:
            if len(column) != points:
                raise wrong_count(scan, len(column), points)
        return columns

    def view(self, columns: list[NDArray[np.integer]]) -> View:
        """The colours of the joined columns."""
        space = SPACES[self.space]
        semantic = columns[0].astype(np.uint8)
        if self.by == "difference":
            return difference_view(semantic, columns[2].astype(np.uint8))
        if self.by in ("instance", "truth-instance"):
            return instance_view(semantic, columns[1], space)
        return class_view(semantic, space)


def _scene(drive: Drive, name: str | None) -> Scene:
    for scene in drive.scenes:
        if name in (None, scene.name):
            return scene
    known = ", ".join(scene.name for scene in drive.scenes[:10])
    raise _bad("unknown-scene", "--scene", f"the log has no scene '{name}'", f"Its scenes are: {known}.")


def _scan(scene: Scene, index: int) -> Scan:
    if index >= len(scene.scans):
        what = f"scene {scene.name} has {len(scene.scans)} scans, there is no scan {index}"
        raise _bad("unknown-scan", "--scan", what, f"Use 0 to {len(scene.scans) - 1}.")
    return scene.scans[index]


def _places(scene: Scene, scans: list[Scan], poses: Path | None, labels: Path | None) -> list[NDArray[np.float64]]:
    """The transform of each scan into one frame: from poses.txt, else from the log."""
    candidates = [poses] if poses is not None else [labels, labels.parent] if labels is not None else []
    for folder in candidates:
        if poses is not None or (folder / "poses.txt").is_file():
            known = read_poses(folder)
            lost = [scan.token for scan in scans if scan.token not in known]
            if not lost:
                return [known[scan.token] for scan in scans]
            if poses is not None:
                what = f"has no pose of scan {lost[0]}"
                raise _bad("missing-poses", str(folder / "poses.txt"), what, "Name the poses made from this log.")
    places = []
    for scan in scans:
        if scan.ego_to_world is None:
            what = "has no poses to accumulate its scans by"
            raise _bad("missing-poses", f"scene {scene.name}", what, "Name a folder with poses.txt by --poses.")
        places.append(scan.ego_to_world @ scan.lidar_to_ego)
    to_first = np.linalg.inv(places[0])
    return [to_first @ place for place in places]


def _short(labels: Path) -> str:
    """The end of a path, which tells primal from refined."""
    return "/".join(labels.resolve().parts[-2:])


def _bad(code: str, where: str, what: str, remedy: str) -> InputError:
    return InputError(Problem(code, where, what, remedy))
