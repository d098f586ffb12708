"""The measurements of ``l3ps bench``, each the work of one process: ``python -m l3ps_cli.bench_tasks TASK FOLDER``.

The folder holds ``arguments.json``; the answer goes to ``TASK.json`` there. The first task leaves the points of both
partitions in it, which other packages then cluster.
"""

from __future__ import annotations

import gc
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

RUNS = 3
PARTITIONS = ("standing.npy", "ground.npy")


def refinement(folder: Path, root: str, scene: str, preset: str, threads: int, scans: int) -> dict[str, Any]:
    """Time and memory of every stage, and time of the clustering alone.

    The growth of memory is what the process needs beyond what it had with the log opened and the primal labels in
    memory, so the points themselves count. It is that of the first run: later ones find memory that was let go.
    """
    from l3ps.pipeline import refine_scene
    from l3ps.presets import PRESETS
    from l3ps.refine.cluster import exact_hdbscan

    drive, part, primal = _inputs(root, scene, scans)
    options = {"sensor_height": drive.sensor_height, "threads": threads}
    points = sum(len(labels.semantic) for labels in primal)
    gc.collect()
    before = _resident_mb()
    costs = []
    for _ in range(RUNS):
        refined = refine_scene(part, primal, PRESETS[preset], **options)
        costs.append(refined.costs)
    stages: dict[str, dict[str, float]] = {}
    for name, first in costs[0].items():
        stages[name] = asdict(first)
        for key in ("seconds", "cpu_seconds"):
            stages[name][key] = statistics.median(getattr(run[name], key) for run in costs)
        stages[name]["growth_mb"] = first.peak_mb - before
        stages[name]["bytes_a_point"] = (first.peak_mb - before) * 2**20 / points
    _save_partitions(folder, part, refined.poses, drive.sensor_height)
    size = PRESETS[preset].min_cluster_size
    return {
        "scans": len(part.scans),
        "points": points,
        "runs": RUNS,
        "stages": stages,
        "seconds": statistics.median(sum(cost.seconds for cost in run.values()) for run in costs),
        "peak_mb": max(stage["peak_mb"] for stage in stages.values()),
        "growth_mb": max(stage["growth_mb"] for stage in stages.values()),
        "bytes_a_point": max(stage["bytes_a_point"] for stage in stages.values()),
        "clustering": _median_seconds(lambda: [exact_hdbscan(own, size, threads) for own in _partitions(folder)]),
    }


def growth(folder: Path, root: str, scene: str, preset: str, threads: int, sizes: Sequence[int]) -> dict[str, Any]:
    """Seconds and microseconds a point of the whole refinement of ever more scans."""
    from l3ps.pipeline import refine_scene
    from l3ps.presets import PRESETS

    del folder
    drive, whole, primal = _inputs(root, scene, max(sizes))
    options = {"sensor_height": drive.sensor_height, "threads": threads}

    def run(scans: int) -> None:
        refine_scene(type(whole)(whole.name, whole.scans[:scans]), primal[:scans], PRESETS[preset], **options)

    run(1)  # loads what is loaded late
    rows = []
    for size in sizes:
        points = sum(len(labels.semantic) for labels in primal[:size])
        seconds = _median_seconds(lambda size=size: run(size))  # type: ignore[misc]
        rows.append({"scans": size, "points": points, "seconds": seconds, "us_a_point": 1e6 * seconds / points})
    return {"growth": rows}


def fast_hdbscan(folder: Path, size: int, threads: int) -> dict[str, float]:
    """Seconds of ``fast_hdbscan``, after a small call: its first one compiles for a minute."""
    os.environ["NUMBA_NUM_THREADS"] = str(threads)
    from fast_hdbscan import HDBSCAN

    partitions = _partitions(folder)
    HDBSCAN(min_cluster_size=size).fit(partitions[0][:2000])
    return _once(lambda part: HDBSCAN(min_cluster_size=size).fit(part), partitions, size)


def hdbscan(folder: Path, size: int, threads: int) -> dict[str, float]:
    """Seconds of ``hdbscan``, in one process: started with more, it took 40 s in place of 24 s for 456,000 points."""
    from hdbscan import HDBSCAN

    del threads
    return _once(lambda part: HDBSCAN(min_cluster_size=size, core_dist_n_jobs=1).fit(part), _partitions(folder), size)


def _once(
    cluster: Callable[[NDArray[np.float32]], object], partitions: Sequence[NDArray[np.float32]], size: int
) -> dict[str, float]:
    began = time.perf_counter()
    for part in partitions:
        if len(part) > size:
            cluster(part)
    return {"seconds": time.perf_counter() - began}


def _median_seconds(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(RUNS):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def _inputs(root: str, scene: str, scans: int) -> tuple[Any, Any, list[Any]]:
    """The drive, the first scans of a scene and labels for them."""
    from l3ps.drivelog import open_drive
    from l3ps.drivelog.types import Scene

    drive = open_drive(Path(root))
    whole = next(one for one in drive.scenes if one.name == scene)
    part = Scene(whole.name, whole.scans[:scans])
    return drive, part, [_stand_in(drive, scan) for scan in part.scans]


def _stand_in(drive: Any, scan: Any) -> Any:
    """Labels that cost about what real ones do: the truth, or road, cars and buildings by height."""
    from l3ps.labels import ScanLabels
    from l3ps.taxonomy import NUSCENES16

    if scan.load_truth is not None and drive.truth_space == NUSCENES16.name:
        truth = scan.load_truth()
        return ScanLabels(scan.token, truth.semantic, truth.instance)
    z = scan.load_points().xyz[:, 2]
    semantic = np.full(len(z), NUSCENES16.index("manmade"), dtype=np.uint8)
    semantic[z < 0] = NUSCENES16.index("car")
    semantic[z < -1.4] = NUSCENES16.index("driveable_surface")
    return ScanLabels(scan.token, semantic, (semantic == NUSCENES16.index("car")).astype(np.int32))


def _save_partitions(folder: Path, scene: Any, poses: NDArray[np.float64], sensor_height: float | None) -> None:
    from l3ps.refine.accumulate import transform
    from l3ps.refine.ground import GroundSegmenter

    split = GroundSegmenter(sensor_height)
    clouds = [scan.load_points() for scan in scene.scans]
    ground = np.concatenate([split(cloud.xyz, cloud.intensity) for cloud in clouds])
    points = np.concatenate([transform(cloud.xyz, pose) for cloud, pose in zip(clouds, poses, strict=True)])
    for name, members in zip(PARTITIONS, (~ground, ground), strict=True):
        np.save(folder / name, points[members])


def _partitions(folder: Path) -> list[NDArray[np.float32]]:
    return [np.load(folder / name) for name in PARTITIONS]


def _resident_mb() -> float:
    """Memory of this process at present, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    task.__name__: task for task in (refinement, growth, fast_hdbscan, hdbscan)
}


def main() -> None:
    """Run one task; an error of ours becomes its answer."""
    from l3ps.errors import InputError, L3psError
    from l3ps_cli import bench_segment_tasks

    task, folder = sys.argv[1], Path(sys.argv[2])
    arguments = json.loads((folder / "arguments.json").read_text())
    try:
        answer = (TASKS | bench_segment_tasks.TASKS)[task](folder, **arguments)
    except InputError as error:
        answer = {"problems": [problem.as_dict() for problem in error.problems]}
    except L3psError as error:
        answer = {"error": str(error)}
    (folder / f"{task}.json").write_text(json.dumps(answer))


if __name__ == "__main__":
    main()
