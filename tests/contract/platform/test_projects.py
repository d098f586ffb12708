"""What belongs to one project does not exist for another."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import func, select, text

from l3ps_platform import workflow
from l3ps_platform.catalog import (
    DEFAULT_PROJECT,
    Catalog,
    DriveRow,
    JobRow,
    Owned,
    ProjectRow,
    bundles,
    drives,
    jobs,
)
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.errors import NotFound

pytestmark = pytest.mark.services
FILE = {"filename": "f.zip", "size": 9, "object_key": "uploads/u/f.zip"}


@pytest.fixture
def other(catalog: Catalog) -> Catalog:
    """The same catalog as another project sees it."""
    with catalog.transaction() as tx:
        tx.session.add(ProjectRow(id="prj_other", name="other", created_at=tx.now))
    return catalog.scoped("prj_other")


def test_rows_of_another_project_cannot_be_found_by_any_query(catalog: Catalog, other: Catalog, play) -> None:
    job = play.submit(1)
    with catalog.reading() as session:
        row = jobs.get(session, job)
        drive, model = row.drive_id, row.model_id
    lookups: list[Callable] = [
        lambda session: jobs.get(session, job),
        lambda session: jobs.lock(session, job),
        lambda session: drives.get(session, drive),
        lambda session: drives.lock(session, drive),
        lambda session: bundles.get(session, model),
        lambda session: bundles.by_name(session, model),
    ]
    with other.reading() as session:
        for lookup in lookups:
            with pytest.raises(NotFound):
                lookup(session)
        assert jobs.page(session) == drives.page(session) == bundles.page(session) == []
        assert drives.many(session, [drive]) == {}
        assert session.get(JobRow, job) is None
        assert session.scalar(select(func.count()).select_from(DriveRow)) == 0
        assert session.execute(select(JobRow.id, DriveRow.id).join(DriveRow)).all() == []
    with pytest.raises(NotFound), other.transaction() as tx:
        workflow.submit_job(tx, drive_id=drive, model=model)
    with pytest.raises(NotFound), other.transaction() as tx:
        workflow.cancel_job(tx, job)


def test_two_projects_may_give_two_models_one_name(catalog: Catalog, other: Catalog) -> None:
    ids = []
    for project in (catalog, other):
        with project.transaction() as tx:
            ids.append(workflow.accept_model(tx, name="street", **FILE).id)
    for project, id in zip((catalog, other), ids, strict=True):
        with project.reading() as session:
            assert bundles.by_name(session, "street").id == id


def test_a_model_named_like_the_id_of_another_does_not_take_its_place(catalog: Catalog) -> None:
    with catalog.transaction() as tx:
        id = workflow.accept_model(tx, name="street", **FILE).id
        shadow = workflow.accept_model(tx, name=id, **FILE).id
    with catalog.reading() as session:
        assert bundles.by_name(session, id).id == id
        assert bundles.by_name(session, "street").id == id
        assert bundles.by_name(session, shadow).id == shadow


def test_a_new_row_belongs_to_the_project_of_its_catalog(catalog: Catalog, other: Catalog) -> None:
    with other.transaction() as tx:
        drive = workflow.accept_drive(tx, name="d", **FILE)
        assert drive.project_id == "prj_other"
    unscoped = Catalog(catalog.url)
    with pytest.raises(ValueError, match="needs a project"), unscoped.transaction() as tx:
        workflow.accept_drive(tx, name="d", **FILE)
    with unscoped.reading() as session:
        assert drives.get(session, drive.id).project_id == "prj_other", "workers see every project's rows"
    unscoped.dispose()


def test_every_table_with_a_project_is_kept_apart() -> None:
    with_project = {mapper.class_ for mapper in DriveRow.registry.mappers if "project_id" in mapper.columns}
    assert {row for row in with_project if not issubclass(row, Owned)} == set()


def test_what_was_there_before_projects_belongs_to_the_default_one(empty_url: str) -> None:
    catalog = Catalog(empty_url)
    upgrade(empty_url, "0002")
    with catalog.transaction() as tx:
        tx.session.execute(
            text(
                "INSERT INTO drives (id, name, filename, size, state, created_at) "
                "VALUES ('drv_1', 'd', 'd.zip', 9, 'ready', '2026-01-01 00:00:00+00:00')"
            )
        )
    upgrade(empty_url)
    with catalog.scoped(DEFAULT_PROJECT).reading() as session:
        assert drives.get(session, "drv_1").name == "d"
    if catalog.engine.dialect.name == "sqlite":
        copies = list(Path(catalog.engine.url.database).parent.glob("*.before-*"))
        with closing(sqlite3.connect(copies[0])) as copy:
            columns = [column[1] for column in copy.execute("PRAGMA table_info(drives)")]
            assert copy.execute("SELECT id FROM drives").fetchall() == [("drv_1",)]
        assert "project_id" not in columns, "the copy is the catalog as it was"
    catalog.dispose()
