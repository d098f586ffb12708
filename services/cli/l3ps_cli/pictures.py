"""Bird's-eye pictures of labelled scans, by class and by instance."""

from __future__ import annotations

from pathlib import Path


def draw_scan(log: Path, labels: Path, folder: Path) -> list[Path]:
    """Draw the middle scan of a log's first scene, by class and by instance.

    Args:
        log: the drive log, directory or archive.
        labels: folder of the label files.
        folder: where the pictures go.

    Returns:
        The PNG files written.
    """
    import cv2
    import numpy as np

    from l3ps.draw import birdseye, class_view, instance_view
    from l3ps.drivelog import opened
    from l3ps.labels import open_labels, read_scan
    from l3ps.taxonomy import NUSCENES16

    folder.mkdir(parents=True, exist_ok=True)
    files = []
    with opened(log) as drive:
        scene = drive.scenes[0]
        scans = [scan for scan in scene.scans if scan.is_keyframe]
        scan = scans[len(scans) // 2]
        found = read_scan(open_labels(labels), None, scene, scan)
        points = scan.load_points().xyz
        views = {
            "classes": class_view(found.semantic, NUSCENES16),
            "instances": instance_view(found.semantic, found.instance, NUSCENES16),
        }
        for name, view in views.items():
            title, subtitle = f"{scene.name}, scan {scan.index}", f"refined labels, {name}"
            picture = birdseye(points, view, sensors=np.zeros((1, 3)), title=title, subtitle=subtitle)
            files.append(folder / f"{name}.png")
            cv2.imwrite(str(files[-1]), picture[:, :, ::-1])
    return files
