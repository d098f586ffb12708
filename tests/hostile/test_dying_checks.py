"""A check whose process dies ends in a rejection after the attempts there are, and the worker goes on."""

import os
import signal
import time

from sqlalchemy import select
from tests.contract.api.conftest import Service

from l3ps_platform.catalog import StageName, StageRow, StageState, UploadRow

from .archives import gz, header, zipped

LARGE = gz(header("log/large", 60 << 20) + bytes(60 << 20))
"""Below every limit, and tenths of a second of work."""


def ingest(service: Service, drive_id: str) -> StageRow:
    with service.catalog.reading() as session:
        wanted = (StageRow.drive_id == drive_id, StageRow.name == StageName.INGEST)
        return session.scalars(select(StageRow).where(*wanted)).one()


def test_a_check_that_dies_every_time_ends_as_not_checked(service, samples):
    """By the kernel's hand, as when memory ends, or by its own, as when compiled code gives up: one of each stack."""
    sign = signal.SIGKILL if service.settings.database_url else signal.SIGABRT
    drive_id = service.upload(LARGE, "deadly.tar.gz").json()["id"]
    killed: set[str] = set()
    deadline = time.monotonic() + 100
    while not (stage := ingest(service, drive_id)).state.final:
        assert time.monotonic() < deadline, (stage.state, stage.attempt)
        owner = stage.lease_owner
        if stage.state is StageState.RUNNING and owner is not None and f"{stage.attempt} {owner}" not in killed:
            killed.add(f"{stage.attempt} {owner}")
            os.kill(int(owner.rpartition(":")[2]), sign)
        time.sleep(0.01)

    assert (len(killed), stage.attempt, stage.state) == (3, 3, StageState.FAILED), killed
    drive = service.http.get(f"/v1/drives/{drive_id}").json()
    (problem,) = drive["problems"]
    assert (drive["state"], problem["code"]) == ("rejected", "not-checked")
    assert problem["what"] and "again" in problem["remedy"]

    after = service.wait_for_drive(service.upload(zipped(samples.log), "after.zip").json()["id"])
    assert after["state"] == "ready"
    work = service.settings.scratch / "work"
    service.wait("/healthz", lambda _: not list(work.iterdir()))  # swept by the next stage
    with service.catalog.reading() as session:
        upload = session.scalars(select(UploadRow).where(UploadRow.result_id == drive_id)).one()
    service.wait("/healthz", lambda _: upload.object_key not in service.objects())  # deleted by the reconciler
