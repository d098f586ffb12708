"""``l3ps label``: the whole method in this process, no services."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from numpy.typing import NDArray

from l3ps.costs import CostBook
from l3ps.drivelog import opened, validate, without_bad_scans
from l3ps.drivelog.types import Drive, Scene
from l3ps.errors import DriveLogError, InputError, Problem
from l3ps.evaluate import PROTOCOLS, PanopticEvaluator, evaluate_scene, rank_correlation
from l3ps.labels import FORMATS, LabelFormat, ScanLabels, write_poses, write_scene
from l3ps.pipeline import RefinedScene, primal_labels, refine_scene
from l3ps.presets import DEFAULT_PRESET, PRESETS, Preset
from l3ps.refine.poses import Motion
from l3ps.segment.bundle import ModelBundle
from l3ps.segment.presets import DEFAULT_SEGMENT, SEGMENT_PRESETS
from l3ps.segment.session import Segmenter
from l3ps_cli.errors import BAD_INPUT, clear_errors, err, fail, out, stopped_by_sigterm
from l3ps_cli.progress import bars
from l3ps_cli.report import quality_table

T = TypeVar("T")
LABEL_SUFFIXES = ("_panoptic.npz", "_lidarseg.bin", ".label", "_confidence.npz")
SHOWN_WARNINGS = 5
PARTS = ("primal", "refined", "poses.txt", "scans.txt")


@dataclass
class Run:
    """What is gathered over the scenes of one run."""

    scenes: list[dict[str, Any]] = field(default_factory=list)
    poses: list[tuple[Scene, NDArray[np.float64]]] = field(default_factory=list)
    quality: dict[str, PanopticEvaluator] = field(default_factory=dict)

    def score(self, side: str, evaluator: PanopticEvaluator) -> None:
        """Add one scene's counts to those of ``primal`` or ``refined``."""
        if side in self.quality:
            self.quality[side].merge(evaluator)
        else:
            self.quality[side] = evaluator


def label(
    log: Annotated[Path, typer.Argument(help="Drive log: a directory or archive of any supported format.")],
    model: Annotated[Path, typer.Option(help="Model bundle: a directory or zip.")],
    output: Annotated[Path, typer.Option("--out", help="Folder for the labels.")],
    preset: Annotated[str, typer.Option(help=f"{', '.join(PRESETS)}.")] = DEFAULT_PRESET,
    segment: Annotated[str, typer.Option(help=f"Look at images: {', '.join(SEGMENT_PRESETS)}.")] = DEFAULT_SEGMENT,
    label_format: Annotated[str, typer.Option("--format", help=f"{', '.join(FORMATS)}.")] = "nuscenes",
    report: Annotated[Path | None, typer.Option(help="Write costs and quality to this JSON file.")] = None,
    scene: Annotated[str | None, typer.Option(help="Only this scene.")] = None,
    skip_bad_scans: Annotated[bool, typer.Option("--skip-bad-scans", help="Label the good scans of a log.")] = False,
    protocol: Annotated[str | None, typer.Option(help="nuscenes, paper or semantickitti.")] = None,
    threads: Annotated[int, typer.Option(min=1, max=256, help="Threads of each step.")] = 2,
) -> None:
    """Label every LiDAR point of a drive log; with truth in the log, score the labels too."""
    with clear_errors(), stopped_by_sigterm():
        parameters = _choose(PRESETS, preset, "--preset")
        look = _choose(SEGMENT_PRESETS, segment, "--segment")
        written_as = _choose(dict(zip(FORMATS, FORMATS, strict=True)), label_format, "--format")
        if protocol is not None:
            _choose(PROTOCOLS, protocol, "--protocol")
        if report is not None:
            report.parent.mkdir(parents=True, exist_ok=True)
            report.open("a").close()  # better to fail now than after the work
        started = time.perf_counter()
        segmenter = Segmenter(ModelBundle.load(model), threads, parameters.min_area, look)
        with opened(log) as whole, _all_or_nothing(output) as staging:
            drive = _checked(_limited(whole, scene), skip_bad_scans)
            for one in drive.scenes:
                if any(scan.load_truth is not None for scan in one.scans):
                    evaluate_scene(drive, one, [], protocol or drive.truth_space)  # refuses what it could not score
            run = Run()
            for one in drive.scenes:
                _label_scene(drive, one, segmenter, parameters, written_as, staging, run, protocol, threads)
            write_poses(staging, run.poses)
    summary = {
        "log": log.name,
        "format": drive.format,
        "model": segmenter.bundle.info.name,
        "preset": parameters.as_dict(),
        "segment": look.as_dict(),
        "seconds": time.perf_counter() - started,
        "scenes": run.scenes,
        "quality": {side: evaluator.quality().as_dict() for side, evaluator in run.quality.items()},
    }
    if report is not None:
        report.write_text(json.dumps(summary, indent=2) + "\n")
    _show(summary, output)


def _label_scene(
    drive: Drive,
    scene: Scene,
    segmenter: Segmenter,
    preset: Preset,
    label_format: LabelFormat,
    target: Path,
    run: Run,
    protocol: str | None,
    threads: int,
) -> None:
    with bars(f"{scene.name}  ") as progress:
        book = CostBook()
        with book.span("segment"):
            primal = primal_labels(scene, segmenter, progress)
        refined = refine_scene(
            scene, primal, preset, sensor_height=drive.sensor_height, threads=threads, progress=progress
        )
    _warn(refined.warnings)
    sides: dict[str, Sequence[ScanLabels]] = {"primal": primal, "refined": refined.labels}
    for side, labels in sides.items():
        write_scene(target / side, label_format, scene, labels)
        if any(scan.load_truth is not None for scan in scene.scans):
            run.score(side, evaluate_scene(drive, scene, labels, protocol or drive.truth_space))
    costs = book.stages | refined.costs
    run.poses.append((scene, refined.poses))
    run.scenes.append(
        {
            "name": scene.name,
            "scans": len(scene.scans),
            "points": sum(len(labels.semantic) for labels in primal),
            "stages": {stage: asdict(cost) for stage, cost in costs.items()},
            "poses": _poses(refined.motion),
            "warnings": [problem.as_dict() for problem in refined.warnings],
            **_estimates(drive, scene, refined, protocol or drive.truth_space),
        }
    )


def _poses(motion: Motion) -> dict[str, Any]:
    """Whose poses, and how far neighbouring scans lie apart under them in metres; None where nothing tells."""
    known = motion.residual[np.isfinite(motion.residual)]
    return {
        "source": motion.source,
        "parts": len(motion.starts),
        "residual": float(known.mean()) if len(known) else None,
    }


def _estimates(drive: Drive, scene: Scene, refined: RefinedScene, protocol: str) -> dict[str, Any]:
    """Each scan's estimated quality, beside its true PQ and their rank correlation where there is truth."""
    rows = [estimate.as_dict() for estimate in refined.estimates]
    truths: list[float | None] = []
    for scan, labels, row in zip(scene.scans, refined.labels, rows, strict=True):
        pq = None
        if scan.load_truth is not None:
            pq = evaluate_scene(drive, replace(scene, scans=(scan,)), [labels], protocol).quality().pq
            row["pq"] = pq
        truths.append(pq)
    correlation = rank_correlation([estimate.estimate for estimate in refined.estimates], truths)
    return {"estimates": rows, "rank_correlation": correlation}


def _warn(problems: Sequence[Problem]) -> None:
    """The first few warnings; the report has all."""
    for problem in problems[:SHOWN_WARNINGS]:
        err.print(f"Warning: {problem}", style="yellow", markup=False, highlight=False)
    if len(problems) > SHOWN_WARNINGS:
        err.print(f"… and {len(problems) - SHOWN_WARNINGS} more warnings.", style="yellow")


def _limited(drive: Drive, scene: str | None) -> Drive:
    if scene is None:
        return drive
    chosen = tuple(s for s in drive.scenes if s.name == scene)
    if not chosen:
        known = ", ".join(s.name for s in drive.scenes[:10])
        raise DriveLogError(
            Problem("unknown-scene", "--scene", f"the log has no scene '{scene}'", f"Its scenes are: {known}.")
        )
    return replace(drive, scenes=chosen)


def _checked(drive: Drive, skip_bad_scans: bool) -> Drive:
    problems = validate(drive)
    for problem in problems:
        if problem.severity == "warning":
            err.print(f"Warning: {problem}", style="yellow", markup=False, highlight=False)
    bad = [problem for problem in problems if problem.severity != "warning"]
    if bad and not (skip_bad_scans and all(problem.severity == "scan" for problem in bad)):
        raise DriveLogError(bad)
    for problem in bad:
        err.print(f"Left out: {problem}", style="yellow", markup=False, highlight=False)
    return without_bad_scans(drive, bad) if bad else drive


@contextmanager
def _all_or_nothing(target: Path) -> Iterator[Path]:
    """A folder to write to that replaces the labels in ``target`` only when the block ends well.

    Raises:
        InputError: ``target`` cannot be written to, or holds files in the labels' places that are no labels.
    """
    _refuse_foreign_files(target)
    is_new = not target.exists()
    try:
        target.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".partial-", dir=target))
    except OSError as error:
        what = f"the folder cannot be made or written to ({error.strerror})"
        raise InputError(Problem("bad-output", str(target), what, "Name a folder that you may write to.")) from error
    try:
        yield staging
        for part in PARTS:
            old = target / part
            if old.is_dir():
                shutil.rmtree(old)
            (staging / part).replace(old)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if is_new:
            with suppress(OSError):
                target.rmdir()  # only where nothing was written


def _refuse_foreign_files(target: Path) -> None:
    for part in ("primal", "refined"):
        for path in sorted((target / part).rglob("*")):
            if path.is_file() and not path.name.endswith(LABEL_SUFFIXES):
                what = f"{part}/ would be replaced but holds {path.relative_to(target)}, which is no label file"
                raise InputError(Problem("bad-output", str(target), what, "Move it away, or name another folder."))


def _choose(known: dict[str, T], name: str, option: str) -> T:
    if name not in known:
        fail(f"{option}: there is no '{name}'. Use one of {', '.join(known)}.", BAD_INPUT)
    return known[name]


def _show(summary: dict[str, Any], output: Path) -> None:
    quality = summary["quality"]
    if quality:
        out.print(quality_table({"protocol": quality["refined"]["protocol"], **quality}))
    points = sum(scene["points"] for scene in summary["scenes"])
    scans = sum(scene["scans"] for scene in summary["scenes"])
    out.print(f"{points:,} points of {scans} scans in {summary['seconds']:.1f} s", highlight=False)
    out.print(f"Labels: {output}/refined (and {output}/primal), poses: {output}/poses.txt", highlight=False)
