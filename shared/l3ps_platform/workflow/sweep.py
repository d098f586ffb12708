"""The sweep: deletes from the object store what nobody needs any more, and never anything that somebody does.

First the catalog says that it is gone, then the objects go, what makes them whole first: whoever dies in between leaves
something that the next round takes up, and no reader meets half a result.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import datetime, timedelta
from itertools import groupby, islice

import structlog
from sqlalchemy import update

from l3ps_platform.catalog import annotation_sets, belongings, bundles, drives, jobs, outputs, trainings, uploads
from l3ps_platform.catalog.models import AnnotationsRow, DriveRow, JobRow, ModelRow, UploadRow
from l3ps_platform.catalog.session import Catalog
from l3ps_platform.catalog.states import OutputState, StageName, UploadState
from l3ps_platform.errors import Conflict, StoreError
from l3ps_platform.objects import ObjectStore
from l3ps_platform.settings import Settings
from l3ps_platform.workflow.claims import changed
from l3ps_platform.workflow.expiry import expire
from l3ps_platform.workflow.pins import doom_output

log = structlog.get_logger(__name__)

BATCH = 100
"""Outputs deleted, and groups of objects looked at, in one round: the reconciler has other duties."""


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
        self._walk: Iterator[tuple[str, datetime]] | None = None
        self._next_walk = 0.0

    def run_once(self) -> dict[str, int]:
        """One round; how much of each kind went."""
        with self._catalog.alone("sweep") as mine:
            if not mine:
                return {}
            return {
                "uploads": self._abort_uploads(),
                "archives": self._delete_archives(),
                "expired_jobs": expire(self._catalog, BATCH),
                "jobs": self._sweep_jobs() + self._sweep_trainings(),
                "outputs": self._delete_outputs(),
                "orphans": self._sweep_orphans(),
            }

    def _abort_uploads(self) -> int:
        with self._catalog.reading() as session:
            over = uploads.expired(session, self._catalog.now(session))
        for row in over:
            with self._catalog.transaction() as tx, suppress(Conflict):  # completed in this moment
                uploads.close(tx, row.id, UploadState.ABORTED)
        with self._catalog.reading() as session:
            rows = uploads.leftover(session)
        for row in rows:
            self._drop_upload(row)
            with self._catalog.transaction() as tx:
                uploads.lock(tx.session, row.id).s3_upload_id = ""
        return len(rows)

    def _drop_upload(self, row: UploadRow) -> None:
        self._store.abort_multipart(row.object_key, row.s3_upload_id)
        self._store.delete(row.object_key)  # joined, when the API died before it could say so

    def _delete_archives(self) -> int:
        with self._catalog.reading() as session:
            found: Iterable[AnnotationsRow | DriveRow | ModelRow] = [
                *annotation_sets.leftover_archives(session),
                *drives.leftover_archives(session),
                *bundles.leftover_archives(session),
            ]
        count = 0
        for row in found:
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
                count += 1
        return count

    def _sweep_jobs(self) -> int:
        """Doom what only deleted jobs used, and delete what was theirs alone."""
        with self._catalog.reading() as session:
            gone = jobs.unswept(session)
        for job in gone:
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
        return len(gone)

    def _sweep_trainings(self) -> int:
        """Delete the checkpoints of trainings that ended long ago; what they made stays while it is a model's."""
        grace = timedelta(seconds=self._settings.orphan_seconds)
        with self._catalog.reading() as session:
            over = trainings.holding_outputs(session, self._catalog.now(session) - grace)
        for training in over:
            with self._catalog.transaction() as tx:
                if not trainings.lock(tx.session, training.id).state.final:  # begun again in this moment
                    continue
                used = outputs.of_training(tx.session, training.id)
                outputs.forget_uses(tx, training_id=training.id)
                kept = [key for key in used if not doom_output(tx, key)]
            for key in kept:
                if self._store.exists(f"{key}/{outputs.MAIN[StageName.TRAIN]}"):
                    self._store.delete(f"{key}/checkpoint.pt")
        return len(over)

    def _delete_outputs(self) -> int:
        with self._catalog.reading() as session:
            rows = outputs.doomed(session, BATCH)
        for row in rows:
            if row.stage in outputs.MAIN:
                self._store.delete(f"{row.key}/{outputs.MAIN[row.stage]}")
            self._store.delete_prefix(f"{row.key}/")
            with self._catalog.transaction() as tx:
                outputs.erase(tx, row.key)
        return len(rows)

    def _sweep_orphans(self) -> int:
        """Look at the next objects of the store; what belongs to no row and is old goes."""
        if self._walk is None:
            if time.monotonic() < self._next_walk:
                return 0
            self._drop_unknown_uploads()
            self._walk = self._groups()
        try:
            groups = list(islice(self._walk, BATCH))
            count = sum(self._drop_orphan(group, newest) for group, newest in groups)
        except StoreError:
            self._walk = None
            raise
        if len(groups) < BATCH:
            self._walk = None
            self._next_walk = time.monotonic() + self._settings.orphans_every_seconds
        return count

    def _groups(self) -> Iterator[tuple[str, datetime]]:
        """The objects of each owner: their common prefix and the age of the newest."""
        for top in belongings.TOPS:
            found = (info for info in self._store.list(top) if info.key.count("/") > 1)
            for group, infos in groupby(found, key=lambda info: belongings.group_of(info.key)):
                yield group, max(info.modified for info in infos)

    def _drop_orphan(self, group: str, newest: datetime) -> bool:
        with self._catalog.reading() as session:
            before = self._catalog.now(session) - timedelta(seconds=self._settings.orphan_seconds)
            if newest >= before or belongings.owned(session, group):
                return False
            project = belongings.project_of_group(session, group)
        log.info("orphans found", group=group)
        if project is None:
            self._store.delete_prefix(f"{group}/")
            return True
        # A stage may be about to pin it: so it goes the way of all outputs, which takes its row.
        with self._catalog.transaction() as tx:
            if outputs.lock(tx.session, group) is None:
                stage = StageName(group.split("/")[2].partition("-")[0])
                outputs.hold(tx, group, stage, project).state = OutputState.DOOMED
        return True

    def _drop_unknown_uploads(self) -> None:
        """Multipart uploads that the catalog does not know: the API died between the store and the row."""
        with self._catalog.reading() as session:
            now = self._catalog.now(session)
            before = now - timedelta(seconds=max(self._settings.orphan_seconds, self._settings.upload_ttl_seconds))
            pending = [one for one in self._store.list_multipart() if one.begun < before]
            unknown = [one for one in pending if not belongings.open_upload(session, one.key, one.upload_id)]
        for one in unknown:
            self._store.abort_multipart(one.key, one.upload_id)
        self._store.tidy(now - timedelta(seconds=self._settings.orphan_seconds))
