"""Uploads over the real API: what becomes a drive, what is refused, and that nothing of the refused remains."""

import hashlib
import io
import tarfile

import httpx
import pytest

from l3ps_cli.packing import pack_bundle
from l3ps_platform.catalog import UploadState, uploads

MiB = 1 << 20


def tar_of(**files: bytes) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


@pytest.fixture
def nothing_kept(service):
    """Whatever the test sends, nothing has come to store and catalog (things may go: workers reject other archives)."""
    before = service.objects()
    drives = {drive["id"] for drive in service.http.get("/v1/drives").json()["items"]}
    yield
    assert service.objects() <= before
    assert {drive["id"] for drive in service.http.get("/v1/drives").json()["items"]} <= drives


def test_an_archive_in_several_parts_becomes_a_drive(service):
    data = tar_of(blob=bytes(12 * MiB))
    upload = service.announce(len(data), "morning.tar")
    assert len(upload["parts"]) == 3
    parts = service.put_parts(upload, data)
    digest = hashlib.sha256(data).hexdigest()
    completion = {"parts": parts, "sha256": digest}
    answer = service.http.post(f"/v1/uploads/{upload['id']}/complete", json=completion)
    assert answer.status_code == 202
    drive = answer.json()
    assert (drive["name"], drive["size"], drive["sha256"]) == ("morning", len(data), digest)
    assert answer.headers["location"] == f"/v1/drives/{drive['id']}"
    assert service.http.get(answer.headers["location"]).status_code == 200

    again = service.http.post(f"/v1/uploads/{upload['id']}/complete", json=completion)
    assert again.json()["id"] == drive["id"], "a client that lost the answer gets the same drive"


def test_an_empty_file_is_refused_at_once(service, nothing_kept):
    answer = service.http.post("/v1/uploads", json={"kind": "drive", "filename": "log.zip", "size": 0})
    document = service.refused(answer, 422, "empty-upload")
    assert document["errors"][0]["where"] == "size"
    assert "0 bytes" in document["detail"]


def test_a_file_that_arrives_empty_is_refused(service, nothing_kept):
    upload = service.announce(10)
    parts = service.put_parts(upload, b"")
    answer = service.http.post(f"/v1/uploads/{upload['id']}/complete", json={"parts": parts})
    assert "0 bytes arrived" in service.refused(answer, 422, "wrong-size")["detail"]


def test_what_is_no_archive_is_refused_and_forgotten(service, nothing_kept):
    upload = service.announce(11, "log.zip")
    parts = service.put_parts(upload, b"not a zip!!")
    path = f"/v1/uploads/{upload['id']}"
    document = service.refused(service.http.post(f"{path}/complete", json={"parts": parts}), 422, "not-an-archive")
    assert document["errors"][0]["where"] == "log.zip"
    assert "6e 6f 74" in document["detail"] and ".tar.zst" in document["detail"]
    assert service.http.get(path).json()["state"] == "aborted"
    service.refused(service.http.post(f"{path}/complete", json={"parts": parts}), 409, "upload-closed")


@pytest.mark.parametrize("head", [b"PK\x03\x04", b"\x1f\x8b\x08", b"\x28\xb5\x2f\xfd", bytes(257) + b"ustar"])
def test_every_archive_is_known_by_its_first_bytes_not_its_name(service, head):
    answer = service.upload(head + bytes(100), "log.bin")
    assert answer.status_code == 202, answer.text


def test_a_file_of_another_size_than_announced_is_refused(service, nothing_kept):
    data = tar_of(a=b"x")
    upload = service.announce(len(data) + 1)
    parts = service.put_parts(upload, data)
    answer = service.http.post(f"/v1/uploads/{upload['id']}/complete", json={"parts": parts})
    service.refused(answer, 422, "wrong-size")


def test_a_wrong_etag_names_the_parts_and_the_upload_can_go_on(service):
    data = tar_of(a=b"x")
    upload = service.announce(len(data))
    parts = service.put_parts(upload, data)
    path = f"/v1/uploads/{upload['id']}/complete"
    bad = [{"number": 1, "etag": "0" * 32}]
    assert service.refused(service.http.post(path, json={"parts": bad}), 422, "invalid-parts")["errors"]
    service.refused(service.http.post(path, json={"parts": [*parts, *bad]}), 422, "invalid-parts")
    assert service.http.post(path, json={"parts": parts}).status_code == 202


def test_a_file_over_the_limit_is_refused_before_a_byte_is_sent(service, nothing_kept):
    answer = service.http.post("/v1/uploads", json={"kind": "drive", "filename": "log.tar", "size": 1 << 50})
    assert "L3PS_MAX_UPLOAD_BYTES" in service.refused(answer, 413, "too-large")["detail"]


def test_an_aborted_upload_leaves_no_parts(service, nothing_kept):
    data = tar_of(a=b"x")
    upload = service.announce(len(data))
    parts = service.put_parts(upload, data)
    path = f"/v1/uploads/{upload['id']}"
    assert service.http.delete(path).status_code == 204
    service.refused(service.http.post(f"{path}/complete", json={"parts": parts}), 409, "upload-closed")
    service.refused(service.http.delete(path), 409, "conflict")
    with service.catalog.reading() as session:
        assert uploads.get(session, upload["id"]).state is UploadState.ABORTED
    assert httpx.put(upload["parts"][0]["url"], content=data).is_error


def test_an_unknown_upload_is_a_404(service):
    service.refused(service.http.get("/v1/uploads/upl_nothing"), 404, "unknown-upload")


def test_a_models_name_is_taken_by_other_content_but_not_by_its_own(service, bundle, tmp_path):
    archive = tmp_path / "colours.zip"
    pack_bundle(bundle, archive)
    one, two = archive.read_bytes(), archive.read_bytes() + b"\0"

    def upload(data: bytes) -> httpx.Response:
        digest = hashlib.sha256(data).hexdigest()
        return service.upload(data, "colours.zip", "model", name="only-once", sha256=digest)

    first = upload(one)
    assert first.status_code == 202, first.text
    service.wait("/v1/models/only-once", lambda model: model["state"] == "ready")
    kept = service.objects()
    assert upload(one).json()["id"] == first.json()["id"]
    service.refused(upload(two), 409, "name-taken")
    assert service.objects() <= kept
    assert service.http.get("/v1/models/only-once").json()["id"] == first.json()["id"]


def test_a_models_name_must_be_usable_in_a_path(service, nothing_kept):
    answer = service.upload(b"PK\x03\x04....", "tiny.zip", "model", name="a/b")
    assert service.refused(answer, 422, "bad-name")["errors"][0]["where"] == "name"
    service.http.delete(answer.request.url.path.removesuffix("/complete"))
