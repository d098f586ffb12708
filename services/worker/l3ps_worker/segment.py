"""A scene's primal labels: images through the network, projected onto the points."""

from __future__ import annotations

from contextlib import suppress

from l3ps.costs import CostBook
from l3ps.pipeline import primal_labels
from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.errors import ObjectMissing
from l3ps_worker.arrays import write_labels
from l3ps_worker.context import Context
from l3ps_worker.keys import segment_key
from l3ps_worker.outputs import pin
from l3ps_worker.work import Done, SceneWork, model_file, opened_scene, scene_work


def segment(context: Context, claim: workflow.Claim, progress: Progress) -> Done:
    """Compute and store the primal labels, unless the same ones are there already."""
    work = scene_work(context, claim)
    key = primal_key(work)
    prefix = key.rpartition("/")[0]

    size = 0

    def finish(tx: workflow.Transaction, claim: workflow.Claim, cost: workflow.Cost) -> None:
        workflow.complete(tx, claim, cost, output_key=key)
        workflow.note_output(tx, prefix, size)

    pin(context, claim, prefix, progress)
    with suppress(ObjectMissing):
        size = context.store.stat(key).size  # whoever stored it may have died before noting it
        return Done(finish, work.scene.scans, work.scene.points, cached=True)
    book = CostBook()
    with opened_scene(context, work, progress) as (_, scene), context.scratch.workdir() as folder:
        with model_file(context, work.model, progress) as bundle:
            assert work.model.sha256 is not None
            segmenter = context.segmenter(work.model.sha256, bundle, work.preset.min_area, work.look)
        with book.span("segment"):
            labels = primal_labels(scene, segmenter, progress)
        write_labels(folder / "primal.npz", labels)
        context.store.put_file(key, folder / "primal.npz")
        size = (folder / "primal.npz").stat().st_size
    steps = {name: (cost.seconds, cost.peak_mb) for name, cost in book.stages.items()}
    return Done(finish, len(labels), sum(len(scan.semantic) for scan in labels), steps=steps)


def primal_key(work: SceneWork) -> str:
    """Where the scene's primal labels lie."""
    assert work.drive.sha256 is not None and work.model.sha256 is not None
    inputs = work.job.project_id, work.drive.sha256, work.model.sha256, work.scene.name
    return f"{segment_key(*inputs, work.preset, work.look, skip=work.skip)}/primal.npz"
