"""Write whole drives: worlds, sensors, files and tables."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import cv2
import numpy as np
from numpy.typing import NDArray

from ..progress import Progress, silent
from ..taxonomy import INSTANCE_FACTOR
from . import boxes, lidar
from .camera import RIG, Mount, Picture, Renderer
from .nuscenes_tables import VERSION, Tables
from .output import check_arguments, whole
from .street import Surface
from .traffic import build_world
from .world import World

PERIOD = 500_000
"""Microseconds between keyframes (2 Hz)."""
EPOCH = 1_700_000_000_000_000
"""Time stamp of the first scan of the first scene, microseconds."""
WIDTH = 704
"""Default image width; heights are 9/16 of it. At this size a picture takes about 0.2 s of one core."""
JPEG_QUALITY = 92
MAP_STEP = 0.1
"""Metres a pixel of the map mask; fixed by the devkit."""
MAP_METRES = 500.0
"""Edge of the mask; the street lies around its middle."""


def simulate_drive(
    out: Path,
    scenes: int,
    scans: int,
    seed: int,
    progress: Progress = silent,
    *,
    image_truth: bool = False,
    width: int = WIDTH,
    threads: int = 2,
) -> None:
    """Write a drive in nuScenes v1.0 layout with cameras, panoptic truth and boxes.

    The same arguments give the same bytes, whatever the number of threads. Nothing appears at ``out`` until the
    drive is complete.

    Args:
        out: the log's directory; must not exist or be empty.
        scenes: number of scenes, each a street of its own.
        scans: keyframes a scene, at 2 Hz.
        seed: of all randomness.
        progress: called with stage ``simulate`` after each scan.
        image_truth: also write pixel truth, ``image_truth/<channel>/<image name>.png``, 16 bit: challenge class *
            1000 + instance, sky being class 17.
        width: of the images in pixels, a multiple of 16; the height is 9/16 of it.
        threads: pictures drawn at a time.

    Raises:
        InputError: an argument is out of range or ``out`` is in use.
    """
    check_arguments(out, width, (("scenes", scenes, 1), ("scans", scans, 1), ("seed", seed, 0)))
    with whole(out) as staging:
        writer = _Writer(staging, seed, (width, width * 9 // 16), image_truth)
        with ThreadPoolExecutor(max_workers=threads) as pool:
            try:
                for scene in range(scenes):
                    for done in writer.scene(scene, scans, pool):
                        progress("simulate", scene * scans + done, scenes * scans)
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        writer.tables.write(staging / VERSION)


def annotated_images(count: int, seed: int, width: int = WIDTH) -> Iterator[Picture]:
    """Single annotated pictures, each of another street and hour, the cameras in turn: what a trainer learns from.

    Args:
        count: how many.
        seed: of all randomness; picture i does not depend on ``count``.
        width: in pixels, a multiple of 16.
    """
    for i in range(count):
        rng = np.random.default_rng([seed, i, 1])
        world = build_world(rng, 10.0)
        yield Renderer(world).picture(RIG[i % len(RIG)], float(rng.uniform(0, 10)), (width, width * 9 // 16), rng)


class _Writer:
    """Files and tables of one drive in the making."""

    def __init__(self, root: Path, seed: int, size: tuple[int, int], image_truth: bool) -> None:
        self.root, self.seed, self.size, self.image_truth = root, seed, size, image_truth
        self.tables = Tables(seed)
        self.tables.sensor("LIDAR_TOP", "lidar")
        folders = [f"samples/{mount.channel}" for mount in RIG] + ["samples/LIDAR_TOP", "maps"]
        folders += [f"lidarseg/{VERSION}", f"panoptic/{VERSION}"]
        folders += [f"image_truth/{mount.channel}" for mount in RIG] if image_truth else []
        for folder in folders:
            (root / folder).mkdir(parents=True)
        for mount in RIG:
            self.tables.sensor(mount.channel, "camera")

    def scene(self, index: int, scans: int, pool: ThreadPoolExecutor) -> Iterator[int]:
        """Draw and write one scene; yields the number of finished scans after each."""
        name = f"scene-{index + 1:04d}"
        world = build_world(np.random.default_rng([self.seed, index]), scans * PERIOD / 1e6)
        start = EPOCH + index * 60_000_000 * (1 + scans // 100)
        stamps = [start + PERIOD * scan for scan in range(scans)]
        date = datetime.fromtimestamp(start / 1e6, UTC).date().isoformat()
        light = "overcast" if world.light.clouds > 0.6 else "sunny" if world.light.clouds < 0.3 else "cloudy"
        samples = self.tables.scene(name, stamps, date, f"simulated street, {light}, seed {self.seed}")
        self.tables.calibrated_sensor(name, "LIDAR_TOP", lidar.lidar_to_ego())
        for mount in RIG:
            self.tables.calibrated_sensor(name, mount.channel, mount.camera_to_ego, mount.intrinsic(*self.size))
        self._map(name, world)
        renderer = Renderer(world)
        pending: list[list[Future[None]]] = []
        for scan, (sample, stamp) in enumerate(zip(samples, stamps, strict=True)):
            jobs = []
            for camera, mount in enumerate(RIG):
                rng = np.random.default_rng([self.seed, index, scan, camera])
                fired = stamp + round(mount.delay * 1e6) + int(rng.integers(-1500, 1500))
                jobs.append(self._exposure(name, sample, mount, fired, (fired - start) / 1e6, renderer, rng, pool))
            pending.append(jobs)
        for scan, (sample, stamp) in enumerate(zip(samples, stamps, strict=True)):
            rng = np.random.default_rng([self.seed, index, scan, len(RIG)])
            self._sweep(name, sample, stamp, (stamp - start) / 1e6, world, rng)
            for job in pending[scan]:
                job.result()
            yield scan + 1

    def _exposure(
        self, scene: str, sample: str, mount: Mount, fired: int, time: float, renderer: Renderer,
        rng: np.random.Generator, pool: ThreadPoolExecutor,
    ) -> Future[None]:  # fmt: skip
        stem = f"{scene}__{mount.channel}__{fired}"
        pose = renderer.world.tilt @ renderer.world.ego_pose(time)
        filename = f"samples/{mount.channel}/{stem}.jpg"
        self.tables.sample_data(sample, scene, mount.channel, fired, pose, filename, self.size)

        def draw() -> None:
            picture = renderer.picture(mount, time, self.size, rng)
            _, jpeg = cv2.imencode(".jpg", picture.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            (self.root / filename).write_bytes(jpeg.tobytes())
            if self.image_truth:
                truth = picture.semantic.astype(np.uint16) * INSTANCE_FACTOR + picture.instance
                _, png = cv2.imencode(".png", truth)
                (self.root / "image_truth" / mount.channel / f"{stem}.png").write_bytes(png.tobytes())

        return pool.submit(draw)

    def _sweep(
        self, scene: str, sample: str, stamp: int, time: float, world: World, rng: np.random.Generator
    ) -> None:  # fmt: skip
        ego = world.ego_pose(time)
        filename = f"samples/LIDAR_TOP/{scene}__LIDAR_TOP__{stamp}.pcd.bin"
        data = self.tables.sample_data(sample, scene, "LIDAR_TOP", stamp, world.tilt @ ego, filename)
        scan = lidar.sweep(world, time, rng)
        (self.root / filename).write_bytes(scan.points.tobytes())
        bin_name, npz_name = self.tables.labels(data)
        (self.root / bin_name).write_bytes(scan.raw.tobytes())
        panoptic = scan.raw.astype(np.uint16) * np.uint16(INSTANCE_FACTOR) + scan.instance.astype(np.uint16)
        (self.root / npz_name).write_bytes(_npz(panoptic))

        to_street = ego @ lidar.lidar_to_ego()
        to_lidar = np.linalg.inv(to_street)
        points = scan.points[:, :3].astype(np.float64) @ to_street[:3, :3].T + to_street[:3, 3]
        points = points[np.argsort(points[:, 0], kind="stable")]
        for i, (actor, pose) in enumerate(zip(world.actors, world.poses(time), strict=True)):
            if actor.size is None:
                continue
            center = boxes.center_pose(pose, actor.size)
            inside = boxes.points_inside(points, center, actor.size)
            if inside:
                visible = boxes.share_in_sight(scan, i, to_lidar @ center, actor.size)
                self.tables.annotation(
                    sample, f"{scene}/{i}", actor.category, actor.attribute, world.tilt @ center, actor.size, inside,
                    visible,
                )  # fmt: skip

    def _map(self, name: str, world: World) -> None:
        """The drivable area from above in map coordinates (the devkit insists on a mask)."""
        coarse = 8  # drawn at 0.8 m and enlarged: only a backdrop
        cells = round(MAP_METRES / MAP_STEP / coarse)
        axis = (np.arange(cells) + 0.5) * MAP_STEP * coarse
        x, y = np.meshgrid(axis, axis[::-1])
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size), np.ones(x.size)])
        street = (np.linalg.inv(world.tilt) @ flat).astype(np.float32)
        kind, _ = world.street.surface(street[0], street[1])
        mask = (kind == Surface.ROAD).astype(np.uint8).reshape(cells, cells) * 255
        mask = mask.repeat(coarse, axis=0).repeat(coarse, axis=1)
        _, png = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_BILEVEL, 1])
        (self.root / "maps" / f"{name}.png").write_bytes(png.tobytes())


def _npz(data: NDArray[np.uint16]) -> bytes:
    """A compressed npz with the entry ``data``; numpy's own writer stamps the current time into the file."""
    array = BytesIO()
    np.save(array, data)
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        file.writestr(ZipInfo("data.npy"), array.getvalue(), ZIP_DEFLATED)
    return archive.getvalue()
