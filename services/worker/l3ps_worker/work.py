"""What the stages share: the rows they work on, their inputs, and what they return."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from l3ps.drivelog import Drive, Scene, open_drive, validate, without_bad_scans
from l3ps.errors import ProcessingError
from l3ps.presets import PRESETS, Preset
from l3ps.progress import Progress
from l3ps.segment.presets import DEFAULT_SEGMENT, SEGMENT_PRESETS, SegmentPreset
from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DriveRow,
    JobRow,
    ModelRow,
    SceneRow,
    StageName,
    Transaction,
    bundles,
    drives,
    jobs,
    stages,
)
from l3ps_worker.context import Context
from l3ps_worker.fetching import as_checked, download, fetch_again

Finish = Callable[[Transaction, workflow.Claim, workflow.Cost], None]


@dataclass(frozen=True, slots=True)
class Done:
    """A stage's work is done; how to record it.

    Attributes:
        finish: writes the outcome, in one transaction with all that follows from it.
        scans, points: how much was processed.
        bytes: what an ingest took in and other stages stored.
        cached: the output was there already.
        steps: (seconds, peak MB) of the steps inside.
        child_cpu_seconds: processor time of processes that the stage started.
        afterwards: runs after the commit; what it leaves undone the reconciler does.
    """

    finish: Finish
    scans: int = 0
    points: int = 0
    bytes: int = 0
    cached: bool = False
    steps: dict[str, tuple[float, float]] = field(default_factory=dict)
    child_cpu_seconds: float = 0.0
    afterwards: Callable[[], None] = lambda: None


@dataclass(frozen=True, slots=True)
class SceneWork:
    """The rows behind a segment or refine stage.

    Attributes:
        job, scene, drive, model: the rows.
        primal: key of the scene's primal labels as its segment stage stored them; None before it has. It names the code
            that made them, and a refine stage may run on another version.
    """

    job: JobRow
    scene: SceneRow
    drive: DriveRow
    model: ModelRow
    primal: str | None

    @property
    def preset(self) -> Preset:
        """The job's preset. ProcessingError when this worker does not know it."""
        name = self.job.settings["preset"]
        if name not in PRESETS:
            raise ProcessingError(f"this worker knows no preset {name!r}; it knows {', '.join(PRESETS)}")
        return PRESETS[name]

    @property
    def look(self) -> SegmentPreset:
        """The job's way to look at images; jobs of before there was a choice have none set."""
        name = self.job.settings.get("segment", DEFAULT_SEGMENT)
        if name not in SEGMENT_PRESETS:
            raise ProcessingError(f"this worker knows no segmentation {name!r}; it knows {', '.join(SEGMENT_PRESETS)}")
        return SEGMENT_PRESETS[name]

    @property
    def skip(self) -> bool:
        """Whether scans are left out of this drive; a drive without bad scans gives the same result either way."""
        problems = workflow.problems_of(self.drive.problem)
        return bool(self.job.settings["skip_bad_scans"]) and any(p.severity != "warning" for p in problems)


def scene_work(context: Context, claim: workflow.Claim) -> SceneWork:
    """Read the rows of a scene's stage."""
    assert claim.job_id is not None and claim.scene_id is not None
    with context.catalog.reading() as session:
        job = jobs.get(session, claim.job_id)
        scene = session.get_one(SceneRow, claim.scene_id)
        drive = drives.many(session, [job.drive_id])[job.drive_id]
        of_scene = stages.of_scene(session, scene.id)
        primal = next((stage.output_key for stage in of_scene if stage.name is StageName.SEGMENT), None)
        return SceneWork(job, scene, drive, bundles.get(session, job.model_id), primal)


@contextmanager
def opened_scene(context: Context, work: SceneWork, progress: Progress) -> Iterator[tuple[Drive, Scene]]:
    """The stage's drive, unpacked in the scratch, and its scene; bad scans left out where the job says so."""
    with unpacked(context, work.drive, progress) as root:
        drive = open_drive(root)
        if work.skip:
            drive = without_bad_scans(drive, validate(drive, progress))
        scene = next((scene for scene in drive.scenes if scene.name == work.scene.name), None)
        if scene is None:
            raise ProcessingError(f"drive {work.drive.id} has no scene {work.scene.name!r}: upload the drive again")
        yield drive, scene


@contextmanager
def unpacked(context: Context, drive: DriveRow, progress: Progress) -> Iterator[Path]:
    """The folder of a checked drive's log."""
    assert drive.sha256 is not None

    def make(target: Path) -> None:
        with context.scratch.workdir() as folder:
            fetch_again(context, drive, target, folder, progress)

    with context.scratch.entry(f"drive-{drive.sha256}", make) as root:
        yield root


@contextmanager
def model_file(context: Context, model: ModelRow, progress: Progress) -> Iterator[Path]:
    """The zip of a checked model."""
    assert model.sha256 is not None

    def make(target: Path) -> None:
        as_checked(download(context, model.object_key, target, model.size, progress), model.sha256)

    with context.scratch.entry(f"model-{model.sha256}", make) as path:
        yield path


def sha256_of(path: Path) -> str:
    """Hex sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
