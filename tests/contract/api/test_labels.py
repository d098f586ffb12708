"""Labels scan by scan and as archives, and what is left when they are deleted; over the real API in both stacks."""

import hashlib
import io
import json
import secrets
import tarfile
from datetime import UTC, datetime
from itertools import product

import httpx
import pytest

from l3ps_platform.catalog import (
    DriveRow,
    DriveState,
    JobRow,
    JobState,
    ModelRow,
    ModelState,
    QueueName,
    StageName,
    StageRow,
    StageState,
)
from l3ps_platform.ids import new_id

NAMES = ("4d036dc46ddce", "a" * 120, "scan-ü")  # also one too long for a plain tar header, and one beyond ASCII


def written_job(service, *, formats=("nuscenes",), large: int = 0) -> tuple[str, dict[str, bytes]]:
    """A finished job as a worker leaves it, without the work: its id, and its files of the first format."""
    job_id, at = new_id("job"), datetime.now(UTC).replace(microsecond=0)
    entries, contents = [], {}

    def store(path: str, data: bytes, **about) -> None:
        key = f"jobs/{job_id}/{len(entries)}.bin"
        service.store.put_bytes(key, data)
        digest = hashlib.sha256(data).hexdigest()
        entries.append({"path": path, "size": len(data), "sha256": digest, "key": key} | about)
        if about["format"] in (None, formats[0]):
            contents[path] = data

    for format, side, (number, scan) in product(formats, ("primal", "refined"), enumerate(NAMES)):
        data = secrets.token_bytes(large or 700 * number)  # an empty one too
        store(f"{side}/{format}/{scan}.bin", data, format=format, scan=scan, scene=f"scene-{number % 2}")
    store("poses.txt", b"1 0 0 0\n" * 64, format=None)  # 512 bytes: no padding
    manifest = {"job_id": job_id, "settings": {"formats": list(formats)}, "files": entries}
    manifest_key = f"jobs/{job_id}/manifest.json"
    service.store.put_bytes(manifest_key, json.dumps(manifest).encode())
    with service.catalog.transaction() as tx:
        about = {"filename": "x", "size": 1, "created_at": at}
        drive = DriveRow(id=new_id("drv"), name="written", state=DriveState.READY, **about)
        model = ModelRow(id=new_id("mdl"), name=job_id, state=ModelState.READY, **about)
        tx.session.add_all([drive, model])
        tx.session.flush()
        settings = {"formats": list(formats), "preset": "fast", "protocol": "nuscenes", "skip_bad_scans": False}
        dates = {"created_at": at, "started_at": at, "finished_at": at}
        row = JobRow(
            id=job_id, drive_id=drive.id, model_id=model.id, settings=settings, state=JobState.SUCCEEDED, **dates
        )
        tx.session.add(row)
        tx.session.flush()
        stage = {"name": StageName.PUBLISH, "queue": QueueName.REFINE, "state": StageState.DONE}
        tx.session.add(StageRow(id=new_id("stg"), job_id=job_id, output_key=manifest_key, **stage))
    return job_id, contents


@pytest.fixture(scope="module")
def written(service) -> tuple[str, dict[str, bytes]]:
    return written_job(service, formats=("nuscenes", "semantickitti"))


def test_the_listing_can_be_narrowed(service, written):
    job, _ = written

    def listed(**query) -> list[dict]:
        answer = service.http.get(f"/v1/jobs/{job}/labels", params=query)
        assert answer.status_code == 200, answer.text
        return answer.json()["files"]

    assert len(listed()) == 7
    assert {file["side"] for file in listed(side="primal")} == {"primal"}
    assert {file["scan"] for file in listed(scene="scene-0")} == {NAMES[0], NAMES[2]}
    (file,) = listed(scan=NAMES[1], side="refined", format="semantickitti")
    assert file["path"] == f"refined/semantickitti/{NAMES[1]}.bin" and file["scene"] == "scene-1"
    answer = service.http.get(f"/v1/jobs/{job}/labels", params={"scan": "none"})
    assert service.refused(answer, 422, "invalid-request")["errors"][0]["where"] == "query scan"


def test_the_listing_comes_in_pages(service, written):
    job, _ = written
    url = f"/v1/jobs/{job}/labels"
    whole = service.http.get(url, params={"side": "refined"}).json()
    assert whole.get("next") is None
    paths, cursor = [], {}
    while cursor is not None:
        page = service.http.get(url, params={"side": "refined", "limit": 2} | cursor).json()
        assert len(page["files"]) <= 2
        paths += [file["path"] for file in page["files"]]
        cursor = {"cursor": page["next"]} if page.get("next") else None
    assert paths == [file["path"] for file in whole["files"]] and len(paths) == 3
    for bad in ({"limit": 0}, {"limit": 1001}, {"cursor": "x"}):
        service.refused(service.http.get(url, params=bad), 422, "invalid-request")


def test_one_file_is_there_without_the_archive(service, written):
    job, contents = written
    for path, data in contents.items():
        answer = service.http.get(f"/v1/jobs/{job}/labels/{path}")
        assert answer.status_code == 307
        assert httpx.get(answer.headers["location"]).content == data
    other = f"/v1/jobs/{job}/labels/primal/semantickitti/{NAMES[0]}.bin"
    assert service.http.get(other).status_code == 307, "of any format it wrote"
    for path in ("none.bin", "../manifest.json", "manifest.json", "%2e%2e/%2e%2e/secret"):
        answer = service.http.get(httpx.URL(service.url, raw_path=f"/v1/jobs/{job}/labels/{path}".encode()))
        assert answer.status_code == 404, path


def opened(data: bytes) -> dict[str, bytes]:
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        assert all(member.isreg() and member.mode == 0o644 for member in tar)
        return {member.name: tar.extractfile(member).read() for member in tar}


def test_the_archive_holds_every_file_and_is_as_long_as_it_says(service, written):
    job, contents = written
    answer = service.http.get(f"/v1/jobs/{job}/labels.tar")
    assert answer.status_code == 200, answer.text
    assert int(answer.headers["content-length"]) == len(answer.content)
    assert answer.headers["content-type"] == "application/x-tar"
    files = opened(answer.content)
    manifest = json.loads(files.pop("manifest.json"))
    assert files == contents
    assert {file["path"] for file in manifest["files"]} == set(contents)
    assert all("key" not in file for file in manifest["files"])
    assert service.http.get(f"/v1/jobs/{job}/labels.tar").content == answer.content
    head = service.http.head(f"/v1/jobs/{job}/labels.tar")
    assert head.headers["content-length"] == answer.headers["content-length"] and not head.content


def test_the_archive_can_be_taken_up_at_any_byte(service, written):
    job, _ = written
    url = f"/v1/jobs/{job}/labels.tar"
    whole = service.http.get(url)
    etag, size = whole.headers["etag"], len(whole.content)
    edges = {0, 1, 511, 512, 513, size - 1, *range(0, size, 997)}
    for begin in sorted(edges):
        answer = service.http.get(url, headers={"range": f"bytes={begin}-", "if-match": etag})
        assert answer.status_code == 206, begin
        assert answer.content == whole.content[begin:], begin
        answer = service.http.get(url, headers={"range": f"bytes={begin}-{begin + 600}", "if-range": etag})
        assert answer.content == whole.content[begin : begin + 601], begin
    service.refused(service.http.get(url, headers={"range": f"bytes={size}-"}), 416, "range-not-satisfiable")
    service.refused(service.http.get(url, headers={"if-match": '"another"'}), 412, "changed")
    assert service.http.get(url, headers={"if-none-match": etag}).status_code == 304


def test_jobs_come_together_with_a_folder_each(service, written):
    (one, first), (two, second) = written, written_job(service)
    answer = service.http.get("/v1/labels.tar", params={"job": [one, two, one]})
    files = opened(answer.content)
    wanted = {f"{one}/{path}": data for path, data in first.items()} | {f"{two}/{p}": d for p, d in second.items()}
    assert {name: data for name, data in files.items() if not name.endswith("manifest.json")} == wanted
    middle = len(answer.content) // 2
    rest = service.http.get("/v1/labels.tar", params={"job": [one, two]}, headers={"range": f"bytes={middle}-"})
    assert rest.content == answer.content[middle:]
    service.refused(service.http.get("/v1/labels.tar", params={"job": [one, "job_none"]}), 404, "unknown-job")
    answer = service.http.get("/v1/labels.tar", params={"job": two, "format": "semantickitti"})
    assert "the job wrote nuscenes" in service.refused(answer, 422, "invalid-request")["detail"]


def test_a_store_that_fails_in_the_middle_cuts_the_archive(service):
    """What has come is shorter than was announced: no client takes it for the whole."""
    job, contents = written_job(service, large=3 << 20)
    listing = service.http.get(f"/v1/jobs/{job}/labels").json()["files"]
    last = next(file["path"] for file in reversed(listing) if file["side"] == "refined")
    number = list(contents).index(last)
    service.store.delete(f"jobs/{job}/{number}.bin")
    received = 0
    with pytest.raises(httpx.RemoteProtocolError), service.http.stream("GET", f"/v1/jobs/{job}/labels.tar") as answer:
        assert answer.status_code == 200
        for block in answer.iter_raw():
            received += len(block)
    assert received < int(answer.headers["content-length"])
    assert service.http.get("/healthz").is_success


def test_a_deleted_job_is_gone_with_its_labels(service):
    job, _ = written_job(service)
    assert service.http.delete(f"/v1/jobs/{job}").status_code == 204
    for path in (f"/v1/jobs/{job}", f"/v1/jobs/{job}/labels", f"/v1/jobs/{job}/labels.tar"):
        service.refused(service.http.get(path), 404, "unknown-job")
    service.refused(service.http.delete(f"/v1/jobs/{job}"), 404, "unknown-job")
    assert job not in [item["id"] for item in service.http.get("/v1/jobs", params={"limit": 200}).json()["items"]]
    service.until(lambda: not list(service.store.list(f"jobs/{job}/")))


def test_a_model_can_be_deleted_and_its_jobs_still_be_read(service):
    job, _ = written_job(service)
    assert service.http.delete(f"/v1/models/{job}").status_code == 204
    service.refused(service.http.get(f"/v1/models/{job}"), 404, "unknown-model")
    service.refused(service.http.delete(f"/v1/models/{job}"), 404, "unknown-model")
    assert service.http.get(f"/v1/jobs/{job}").json()["model"]["name"].startswith(job)
    assert service.http.get(f"/v1/jobs/{job}/labels").status_code == 200


def test_limits_of_what_is_kept_are_told_and_enforced(service):
    none = {"max_age_days": None, "max_bytes": None}
    before = service.http.get("/v1/retention").json()
    assert (before["max_age_days"], before["max_bytes"]) == (None, None)
    for bad in (
        {},
        {"max_age_days": 0, "max_bytes": None},
        {"max_age_days": None, "max_bytes": -1},
        {"max_age_days": 1},
    ):
        service.refused(service.http.put("/v1/retention", json=bad), 422, "invalid-request")
    job, _ = written_job(service)
    with service.catalog.transaction() as tx:
        tx.session.get_one(JobRow, job).finished_at = datetime(2026, 1, 1, tzinfo=UTC)
    try:
        answer = service.http.put("/v1/retention", json=none | {"max_age_days": 100})
        assert answer.status_code == 200 and answer.json()["max_age_days"] == 100
        service.until(lambda: service.http.get(f"/v1/jobs/{job}").status_code == 404)
    finally:
        service.http.put("/v1/retention", json=none)
