"""The sweep: deletes from the object store what nobody needs any more, and never anything that somebody does.

First the catalog says that it is gone, then the objects go, what makes them whole first: whoever dies in between leaves
something that the next round takes up, and no reader meets half a result.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import groupby, islice
from typing import TypeVar

import structlog
from sqlalchemy import update
from sqlalchemy.orm import Session

from l3ps_platform.catalog import (
    annotation_sets,
    belongings,
    bundles,
    drives,
    jobs,
    outputs,
    pruning,
    trainings,
    uploads,
)
from l3ps_platform.catalog.models import AnnotationsRow, DriveRow, JobRow, ModelRow, TrainingRow, UploadRow
from l3ps_platform.catalog.output_rows import OutputRow
from l3ps_platform.catalog.session import Catalog
from l3ps_platform.catalog.states import OutputState, StageName, UploadState
from l3ps_platform.errors import Conflict
from l3ps_platform.objects import ObjectStore
from l3ps_platform.settings import Settings
from l3ps_platform.workflow.chores import Chore
from l3ps_platform.workflow.claims import changed
from l3ps_platform.workflow.expiry import expire
from l3ps_platform.workflow.pins import doom_output

log = structlog.get_logger(__name__)

BATCH = 100
"""Rows, and groups of objects, that a step looks at in one round."""
PATIENCE = 5
"""Rows that may fail in one round of a step: what a store refuses may take it half a minute each."""

KEPT = timedelta(days=90)
"""How long the memory of uploads and arrivals that are over is kept, and trainings' logs: nobody asks for an upload's
end after a quarter of a year, and no bucket tells of an object so late."""
PRUNE_SECONDS = 3600.0
PRUNE_BATCH = 1000

Row = TypeVar("Row", AnnotationsRow, DriveRow, JobRow, ModelRow, OutputRow, TrainingRow, UploadRow)


@dataclass(slots=True)
class Group:
    """Objects of one owner: their common prefix, when the newest was written, and, where one may be an archive, their
    keys, a few."""

    name: str
    newest: datetime
    keys: list[str]


class Sweeper:
    """Rounds over catalog and store. Of several processes that sweep one catalog, one does so at a time.

    Args:
        catalog: the catalog; all projects' rows.
        store: where the objects are.
        settings: how long what belongs to nobody is kept.
    """

    def __init__(self, catalog: Catalog, store: ObjectStore, settings: Settings) -> None:
        self._catalog = catalog.whole()
        self._store = store
        self._settings = settings
        self._walk: Iterator[Group] | None = None
        self._next_prune = float("-inf")
        self._next_walk = 0.0
        self._after: dict[object, str] = {}
        self._steps: dict[str, Callable[[], int]] = {
            "uploads": self._abort_uploads,
            "archives": self._delete_archives,
            "expired_jobs": lambda: expire(self._catalog, BATCH, self.chore),
            "jobs": self._sweep_jobs,
            "trainings": self._sweep_trainings,
            "outputs": self._delete_outputs,
            "orphans": self._sweep_orphans,
            "pruned": self._prune,
        }
        self.chore = Chore("sweeper", "round", *self._steps)

    def run(self, stop: threading.Event) -> None:
        """Rounds until ``stop`` is set."""
        while not stop.wait(self._settings.reconcile_seconds):
            report = self.run_once()
            if any(report.values()):
                log.info("swept", **report)

    def run_once(self) -> dict[str, int]:
        """One round; how much of each kind went. A step that fails keeps no other from its turn."""
        done: dict[str, int] = {}
        with self.chore.step("round"), self._catalog.alone("sweep") as mine:
            for name, work in self._steps.items() if mine else ():
                with self.chore.step(name):
                    done[name] = work()
        return done

    def _each(self, step: str, find: Callable[..., list[Row]], work: Callable[[Row], object]) -> int:
        """Do something about the next rows of a step; how many it was done about.

        What failed is passed over until all others had their turn.

        Args:
            step: the step's name.
            find: called with ``session``, ``limit`` and ``after``, the id or key of the last row of the round before.
            work: what to do about a row.
        """
        with self._catalog.reading() as session:
            rows = find(session, limit=BATCH, after=self._after.get(find, ""))
        count, bearable = 0, self.chore.failures[step] + PATIENCE
        for row in rows:
            self._after[find] = row.key if isinstance(row, OutputRow) else row.id
            with self.chore.row(step, self._after[find]):
                work(row)
                count += 1
            if self.chore.failures[step] >= bearable:
                return count
        if len(rows) < BATCH:
            self._after[find] = ""
        return count

    def _abort_uploads(self) -> int:
        with self._catalog.reading() as session:
            over = uploads.expired(session, self._catalog.now(session))
        for row in over:
            with self.chore.row("uploads", row.id), self._catalog.transaction() as tx, suppress(Conflict):
                uploads.close(tx, row.id, UploadState.ABORTED)  # Conflict: completed in this moment
        return self._each("uploads", uploads.leftover, self._drop_upload)

    def _drop_upload(self, row: UploadRow) -> None:
        self._store.abort_multipart(row.object_key, row.s3_upload_id)
        self._store.delete(row.object_key)  # joined, when the API died before it could say so
        with self._catalog.transaction() as tx:
            uploads.lock(tx.session, row.id).s3_upload_id = ""

    def _delete_archives(self) -> int:
        count = self._each("archives", annotation_sets.leftover_archives, self._delete_archive)
        count += self._each("archives", drives.leftover_archives, self._delete_archive)
        return count + self._each("archives", bundles.leftover_archives, self._delete_archive)

    def _delete_archive(self, row: AnnotationsRow | DriveRow | ModelRow) -> None:
        key = row.object_key or ""
        shared = key.startswith("stages/")  # a trained bundle: another training may be about to reuse it
        if key and not shared:
            self._store.delete(key)
        with self._catalog.transaction() as tx:
            # The row as it is now: it may have been deleted, or given way to another, since it was read.
            table = type(row)
            gone = update(table).where(table.id == row.id, table.object_key == row.object_key)
            changed(tx, gone.values(object_key=None))
            if shared:
                doom_output(tx, belongings.group_of(key))

    def _sweep_jobs(self) -> int:
        return self._each("jobs", jobs.unswept, self._sweep_job)

    def _sweep_job(self, job: JobRow) -> None:
        """Doom what only deleted jobs used, and delete what was theirs alone."""
        with self._catalog.reading() as session:
            used = outputs.of_job(session, job.id)
        # One output a transaction: nobody waits for more than one row at a time.
        for key in used:
            with self._catalog.transaction() as tx:
                doom_output(tx, key)
        self._store.delete(f"jobs/{job.id}/manifest.json")
        self._store.delete_prefix(f"jobs/{job.id}/")
        with self._catalog.transaction() as tx:
            row: JobRow = jobs.lock(tx.session, job.id)
            row.swept_at = tx.now
            outputs.forget_uses(tx, job_id=job.id)

    def _sweep_trainings(self) -> int:
        return self._each("trainings", self._ended_trainings, self._sweep_training)

    def _ended_trainings(self, session: Session, *, limit: int, after: str) -> list[TrainingRow]:
        grace = timedelta(seconds=self._settings.orphan_seconds)
        before = self._catalog.now(session) - grace
        return trainings.holding_outputs(session, before, limit=limit, after=after)

    def _sweep_training(self, training: TrainingRow) -> None:
        """Delete the checkpoints of a training that ended long ago; what it made stays while it is a model's."""
        with self._catalog.transaction() as tx:
            if not trainings.lock(tx.session, training.id).state.final:  # begun again in this moment
                return
            used = outputs.of_training(tx.session, training.id)
            outputs.forget_uses(tx, training_id=training.id)
            kept = [key for key in used if not doom_output(tx, key)]
        for key in kept:
            if self._store.exists(f"{key}/{outputs.MAIN[StageName.TRAIN]}"):
                self._store.delete(f"{key}/checkpoint.pt")

    def _delete_outputs(self) -> int:
        return self._each("outputs", outputs.doomed, self._delete_output)

    def _delete_output(self, row: OutputRow) -> None:
        if row.stage in outputs.MAIN:
            self._store.delete(f"{row.key}/{outputs.MAIN[row.stage]}")
        self._store.delete_prefix(f"{row.key}/")
        with self._catalog.transaction() as tx:
            outputs.erase(tx, row.key)

    def _sweep_orphans(self) -> int:
        """Look at the next objects of the store; what belongs to no row and is old goes."""
        if self._walk is None:
            if time.monotonic() < self._next_walk:
                return 0
            with self.chore.row("orphans", "uploads"):
                self._drop_unknown_uploads()
            self._walk = self._groups()
        walk, self._walk = self._walk, None  # from the beginning again, if the store does not list its objects
        groups = list(islice(walk, BATCH))
        count = 0
        for group in groups:
            with self.chore.row("orphans", group.name):
                count += self._drop_orphan(group)
        if len(groups) < BATCH:
            self._next_walk = time.monotonic() + self._settings.orphans_every_seconds
        else:
            self._walk = walk
        return count

    def _groups(self) -> Iterator[Group]:
        """The objects of each owner."""
        for top in belongings.TOPS:
            found = (info for info in self._store.list(top) if info.key != belongings.group_of(info.key))
            for name, infos in groupby(found, key=lambda info: belongings.group_of(info.key)):
                group = Group(name, datetime.min.replace(tzinfo=UTC), [])
                for info in infos:
                    group.newest = max(group.newest, info.modified)
                    if top in belongings.HOLD_ARCHIVES:
                        group.keys.append(info.key)
                yield group

    def _drop_orphan(self, found: Group) -> bool:
        group = found.name
        with self._catalog.reading() as session:
            before = self._catalog.now(session) - timedelta(seconds=self._settings.orphan_seconds)
            if found.newest >= before or belongings.owned(session, group, found.keys):
                return False
            project, stage = belongings.project_of_group(session, group), belongings.stage_of_group(group)
        log.info("orphans found", group=group)
        if project is None or stage is None:
            self._store.delete_prefix(f"{group}/")
            return True
        # A stage may be about to pin it: so it goes the way of all outputs, which takes its row.
        with self._catalog.transaction() as tx:
            if outputs.lock(tx.session, group) is None:
                outputs.hold(tx, group, stage, project).state = OutputState.DOOMED
        return True

    def _prune(self) -> int:
        """Forget what is long over, in portions; the rest of a large heap in the next rounds."""
        if time.monotonic() < self._next_prune:
            return 0
        count, full = 0, False
        for forget in (pruning.uploads, pruning.arrivals, pruning.training_logs):
            with self._catalog.transaction() as tx:
                gone = forget(tx.session, tx.now - KEPT, PRUNE_BATCH)
            count, full = count + gone, full or gone == PRUNE_BATCH
        if not full:
            self._next_prune = time.monotonic() + PRUNE_SECONDS
        return count

    def _drop_unknown_uploads(self) -> None:
        """Multipart uploads that the catalog does not know: the API died between the store and the row."""
        with self._catalog.reading() as session:
            now = self._catalog.now(session)
            before = now - timedelta(seconds=max(self._settings.orphan_seconds, self._settings.upload_ttl_seconds))
            pending = [one for one in self._store.list_multipart() if one.begun < before]
            unknown = [one for one in pending if not belongings.open_upload(session, one.key, one.upload_id)]
        for one in unknown:
            with self.chore.row("orphans", one.key):
                self._store.abort_multipart(one.key, one.upload_id)
        self._store.tidy(now - timedelta(seconds=self._settings.orphan_seconds))
