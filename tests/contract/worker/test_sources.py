"""Jobs on logs that lie in somebody else's bucket: fetched, checked, told apart, and never written to."""

import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from minio import Minio
from tests.contract.worker.conftest import DirectBench

from l3ps_platform import workflow
from l3ps_platform.catalog import DEFAULT_PROJECT
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.settings import Settings


class Bucket:
    """A bucket that others fill."""

    def __init__(self, server: str) -> None:
        user, _, endpoint = server.partition("@")
        key, _, secret = user.partition(":")
        self.server, self.name = server, f"fleet-{secrets.token_hex(4)}"
        self.client = Minio(endpoint, key, secret, secure=False)
        self.client.make_bucket(self.name)

    def put(self, key: str, path: Path) -> None:
        self.client.fput_object(self.name, key, str(path))

    def put_folder(self, prefix: str, folder: Path) -> None:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.put(f"{prefix}/{path.relative_to(folder).as_posix()}", path)

    def content(self) -> dict[str, tuple[str | None, str]]:
        found = self.client.list_objects(self.name, recursive=True)
        return {str(one.object_name): (one.etag, str(one.last_modified)) for one in found}


@pytest.fixture(scope="module")
def bucket(minio_server: str, log: Path, drive_zip: Path) -> Bucket:
    """A log as a folder and as an archive, below the prefix that may be read and beside it."""
    bucket = Bucket(minio_server)
    bucket.put_folder("logs/street", log)
    bucket.put("logs/street.zip", drive_zip)
    return bucket


@pytest.fixture
def bench(tmp_path: Path, bucket: Bucket) -> Iterator[DirectBench]:
    sources = f"s3://{bucket.server}/{bucket.name}/logs?secure=0"
    settings = Settings(data_dir=tmp_path / "data", progress_seconds=0, threads=1, sources=sources)
    upgrade(settings.catalog_url)
    bench = DirectBench(settings)
    bench.catalog = bench.catalog.scoped(DEFAULT_PROJECT)
    bench.store.ensure()
    yield bench
    bench.context.close()


def submit(bench: DirectBench, source: str, model: str = "m") -> str:
    with bench.catalog.transaction() as tx:
        drive = workflow.accept_source(tx, source=source)
        return workflow.submit_job(tx, drive_id=drive.id, model=model, preset="fast").id


def checked(bench: DirectBench, source: str):
    """The drive of a source once it is checked."""
    with bench.catalog.transaction() as tx:
        id = workflow.accept_source(tx, source=source).id
    bench.run()
    return bench.drive(id)


def forget(bench: DirectBench) -> None:
    """Empty the scratch, as another worker's would be."""
    shutil.rmtree(bench.settings.scratch / "cache")
    (bench.settings.scratch / "cache").mkdir()


def test_a_folder_and_an_archive_give_the_labels_that_an_upload_gives(bench, bucket, drive_zip, fast_model):
    before = bucket.content()
    bench.upload_model(fast_model)
    jobs = [submit(bench, f"s3://{bucket.name}/logs/street{suffix}") for suffix in ("", ".zip")]
    jobs.append(bench.submit(bench.upload_drive(drive_zip), preset="fast"))
    bench.run()

    files = []
    for job in jobs:
        assert bench.job(job).state == "succeeded", bench.job(job).error
        files.append({file["path"]: file["sha256"] for file in bench.manifest(job)["files"]})
    assert files[0] == files[1] == files[2] and files[0]
    folder, archive, upload = [bench.drive(bench.job(job).drive_id) for job in jobs]
    assert folder.object_key is None and folder.source == f"s3://{bucket.name}/logs/street"
    assert folder.size == sum(path.stat().st_size for path in _files(drive_zip)) and archive.size == upload.size
    assert archive.sha256 == upload.sha256 != folder.sha256, "equal bytes are one drive to the caches"
    assert bucket.content() == before, "a source is never written to"
    assert not list((bench.settings.scratch / "work").iterdir())


def _files(drive_zip: Path) -> list[Path]:
    return [path for path in drive_zip.with_suffix("").rglob("*") if path.is_file()]


def test_the_digest_is_of_names_and_contents_and_of_nothing_else(bench, bucket, log):
    first = checked(bench, f"s3://{bucket.name}/logs/street")
    bucket.put_folder("logs/copy", log)
    assert checked(bench, f"s3://{bucket.name}/logs/copy").sha256 == first.sha256
    bucket.put("logs/copy/extra.txt", next(log.glob("v1.0-*/scene.json")))
    assert checked(bench, f"s3://{bucket.name}/logs/copy").sha256 != first.sha256


def test_a_log_that_changes_between_check_and_work_fails_the_job_and_says_so(bench, bucket, log, fast_model):
    bucket.put_folder("logs/changing", log)
    bench.upload_model(fast_model)
    job = submit(bench, f"s3://{bucket.name}/logs/changing")
    bench.step()
    bench.step()
    scan = next((log / "samples" / "LIDAR_TOP").iterdir())
    bucket.put(f"logs/changing/{scan.relative_to(log).as_posix()}", next(log.glob("v1.0-*/scene.json")))
    forget(bench)
    bench.run()
    row = bench.job(job)
    assert row.state == "failed" and "has changed since it was checked" in row.error["message"]
    assert row.error["message"].count("tester-secret") == 0


def test_another_worker_fetches_an_unchanged_log_again(bench, bucket, fast_model):
    bench.upload_model(fast_model)
    job = submit(bench, f"s3://{bucket.name}/logs/street")
    bench.step()
    bench.step()
    forget(bench)
    bench.run()
    assert bench.job(job).state == "succeeded", bench.job(job).error


def test_what_is_not_there_or_cannot_be_a_file_is_rejected(bench, bucket, log, tmp_path):
    small = tmp_path / "small"
    small.write_bytes(b"x")
    bucket.put_folder("logs/evil", log)
    for number, name in enumerate(["con", "a b /x", "LOG/../..", "back\\slash", "Scene", "scene"]):
        if ".." not in name:  # servers refuse such keys themselves
            bucket.put(f"logs/evil/{number}/{name}" if "cene" not in name else f"logs/evil/9/{name}", small)
    for place, code in (("none", "nothing-there"), ("evil", "unsafe-path"), ("evil/9", "duplicate-path")):
        drive = checked(bench, f"s3://{bucket.name}/logs/{place}")
        assert drive.state == "rejected" and drive.problem["problems"][0]["code"] == code, drive.problem
        assert drive.problem["problems"][0]["where"].startswith(f"s3://{bucket.name}/logs/{place}")
    assert not list((bench.settings.scratch / "work").iterdir())


def test_the_limits_of_uploads_hold(bench, bucket):
    settings = bench.settings
    for name, value, code in (
        ("unpack_max_files", 5, "too-many-files"),
        ("unpack_max_file_bytes", 1000, "file-too-large"),
        ("unpack_max_total_bytes", 5000, "archive-too-large"),
    ):
        bench.context.settings = settings.model_copy(update={name: value})
        drive = checked(bench, f"s3://{bucket.name}/logs/street")
        assert drive.problem["problems"][0]["code"] == code, drive.problem
    bench.context.settings = settings.model_copy(update={"max_upload_bytes": 1000})
    assert checked(bench, f"s3://{bucket.name}/logs/street.zip").problem["problems"][0]["code"] == "archive-too-large"


def test_a_place_that_is_no_source_any_more_is_not_read(bench, bucket):
    with bench.catalog.transaction() as tx:
        id = workflow.accept_source(tx, source=f"s3://{bucket.name}/logs/street").id
    bench.context.settings = bench.settings.model_copy(update={"sources": type(bench.settings.sources)("")})
    bench.run()
    drive = bench.drive(id)
    assert drive.state == "rejected" and "no longer among the sources" in drive.problem["problems"][0]["what"]


def test_deleting_a_drive_by_reference_leaves_the_bucket_alone(bench, bucket):
    from l3ps_platform.catalog import drives

    before = bucket.content()
    drive = checked(bench, f"s3://{bucket.name}/logs/street")
    with bench.catalog.transaction() as tx:
        drives.delete(tx, drive.id)
    workflow.Sweeper(bench.context.catalog, bench.store, bench.settings).run_once()
    assert bucket.content() == before
