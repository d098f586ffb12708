"""The method alone: scenes shared out among bare processes, no service around them. What two workers are held against.

Two processes on one machine share its memory and caches, so even these do not take half the time of one.
"""

import multiprocessing
import os
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path

WARM_SCENE = 0
_start: Barrier


def seconds(drive: Path, bundle: Path, preset: str, processes: int) -> float:
    """Seconds until the last of ``processes``, one thread each, has labelled its share of the drive's scenes.

    Each has opened the drive, loaded the network and labelled one scene before the clock starts.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # read by libraries that the children import
        os.environ[name] = "1"
    context = multiprocessing.get_context("spawn")
    shares = [(drive, bundle, preset, n, processes) for n in range(processes)]
    with context.Pool(processes, _remember, (context.Barrier(processes),)) as pool:
        return max(pool.starmap(_label, shares, chunksize=1))


def _remember(barrier: Barrier) -> None:
    global _start  # noqa: PLW0603  (a pool's way to hand over what cannot be pickled)
    _start = barrier


def _label(folder: Path, bundle: Path, preset: str, share: int, of: int) -> float:
    import cv2

    from l3ps.drivelog import Scene, open_drive
    from l3ps.pipeline import primal_labels, refine_scene
    from l3ps.presets import PRESETS
    from l3ps.progress import silent
    from l3ps.segment.bundle import ModelBundle
    from l3ps.segment.presets import SEGMENT_PRESETS
    from l3ps.segment.session import Segmenter

    cv2.setNumThreads(1)
    chosen, look = PRESETS[preset], SEGMENT_PRESETS["fast"]
    segmenter = Segmenter(ModelBundle.load(bundle), 1, chosen.min_area, look)
    drive = open_drive(folder)

    def label(scene: Scene) -> None:
        primal = primal_labels(scene, segmenter, silent)
        refine_scene(scene, primal, chosen, sensor_height=drive.sensor_height, threads=1, progress=silent)

    label(drive.scenes[WARM_SCENE])
    _start.wait()
    began = time.monotonic()
    for scene in drive.scenes[share::of]:
        label(scene)
    return time.monotonic() - began
