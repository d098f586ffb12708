"""A model from annotated images: the trainer at work in a child process, and the model registered."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import structlog

from l3ps.drivelog import unpack
from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.catalog import AnnotationsRow, annotation_sets, trainings
from l3ps_worker import backbones
from l3ps_worker.context import Context
from l3ps_worker.fetching import check_sha256, download, unpack_limits
from l3ps_worker.ingest import check_model
from l3ps_worker.keys import train_key
from l3ps_worker.outputs import pin
from l3ps_worker.trainer import children_cpu_seconds
from l3ps_worker.training import OUT, TrainingRun
from l3ps_worker.work import Done, sha256_of

log = structlog.get_logger(__name__)

STEPS = {"fetch": 0.02, "unpack": 0.02, "features": 0.2, "train": 0.6, "export": 0.06, "validate": 0.1}
"""The steps of a training, each with its share of the work."""

_FOLDERS_AROUND = 3
"""How many folders that hold nothing but the next one an archive may begin with."""


def train(context: Context, claim: workflow.Claim, progress: Progress) -> Done:
    """Train, unless the same training is in the store already, and register the model."""
    assert claim.training_id is not None
    with context.catalog.reading() as session:
        row = trainings.get(session, claim.training_id)
    backbone = backbones.find(context.settings.backbones, row.settings["backbone"])
    cpu_seconds = children_cpu_seconds()
    with ExitStack() as held:
        folder = held.enter_context(context.scratch.workdir())
        inputs, digests = {}, []
        for name, id in (("annotations", row.annotations_id), ("validation", row.validation_id)):
            if id is not None:
                given, images = held.enter_context(_unpacked(context, id, progress))
                (folder / name).symlink_to(images, target_is_directory=True)
                inputs[name] = given.filename
                digests.append(given.sha256 or "")
        prefix = train_key(row.project_id, digests, row.settings, backbone.digest)
        run = TrainingRun(
            context, claim, progress, row, folder=folder, inputs=inputs, checkpoint_key=f"{prefix}/checkpoint.pt"
        )
        key, archive = f"{prefix}/bundle.zip", folder / "bundle.zip"
        pin(context, claim, prefix, progress)
        cached = context.store.exists(key)
        if cached:
            context.store.get_file(key, archive)
        else:
            run.run(backbone.options)
            pack(folder / OUT, archive)
        info = check_model(archive, context.settings.threads)
        if not cached:
            context.store.put_file(key, archive)
        elif info["name"] != row.name:
            key = f"trainings/{row.id}/bundle.zip"
            _rename(archive, row.name, folder / OUT)
            context.store.put_file(key, archive)
        with zipfile.ZipFile(archive) as bundle:
            report = json.loads(bundle.read("report.json"))
        size, sha256 = archive.stat().st_size, sha256_of(archive)
    info["name"] = row.name

    def finish(tx: workflow.Transaction, claim: workflow.Claim, cost: workflow.Cost) -> None:
        workflow.training_done(tx, claim, cost, object_key=key, size=size, sha256=sha256, info=info, report=report)
        workflow.note_output(tx, prefix, size)

    return Done(
        finish,
        cached=cached,
        steps=run.steps,
        child_cpu_seconds=children_cpu_seconds() - cpu_seconds,
        afterwards=run.forget,
    )


def pack(folder: Path, archive: Path) -> None:
    """Zip the files of a bundle's folder; the same files always give the same bytes."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as target:
        for path in sorted(path for path in folder.iterdir() if path.is_file()):
            with path.open("rb") as source, target.open(zipfile.ZipInfo(path.name), "w", force_zip64=True) as member:
                while block := source.read(1 << 20):
                    member.write(block)


def _rename(archive: Path, name: str, folder: Path) -> None:
    """Give a bundle that :func:`pack` made another name, by way of a folder to make."""
    with zipfile.ZipFile(archive) as bundle:
        bundle.extractall(folder)
    description = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps(description | {"name": name}, indent=2) + "\n")
    pack(folder, archive)


@contextmanager
def _unpacked(context: Context, id: str, progress: Progress) -> Iterator[tuple[AnnotationsRow, Path]]:
    """Annotations, their checksum compared, and the folder that holds their images."""
    row = _row(context, id)

    def make(target: Path) -> None:
        with context.scratch.workdir() as folder:
            archive = folder / "archive"
            sha256 = download(context, row.object_key, archive, row.size, progress)
            check_sha256(row.sha256, sha256, row.filename)
            limits = unpack_limits(context.settings)
            unpack(archive, target, limits, name=row.filename, contents="images", progress=progress)
        with context.catalog.transaction() as tx:
            annotation_sets.lock(tx.session, id).sha256 = sha256

    with context.scratch.entry(f"annotations-{id}", make) as entry:
        root = entry
        for _ in range(_FOLDERS_AROUND):
            inside = list(root.iterdir())
            if len(inside) != 1 or not inside[0].is_dir():
                break
            root = inside[0]
        yield _row(context, id), root


def _row(context: Context, id: str) -> AnnotationsRow:
    with context.catalog.reading() as session:
        return annotation_sets.get(session, id)
