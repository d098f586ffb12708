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


@pytest.mark.parametrize("length", [0, 9, 11])
def test_a_part_of_another_size_than_announced_is_refused_by_its_url(service, nothing_kept, length):
    upload = service.announce(10)
    assert httpx.put(upload["parts"][0]["url"], content=bytes(length)).is_client_error
    path = f"/v1/uploads/{upload['id']}"
    assert service.http.get(path).json()["received"] == []
    document = service.refused(service.http.post(f"{path}/complete", json={}), 422, "invalid-parts")
    assert "1 of 1 parts have not arrived" in document["detail"]
    assert service.http.delete(path).status_code == 204


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


def test_a_part_that_slipped_in_with_another_size_is_refused_and_forgotten(service, nothing_kept):
    """An S3 server that does not look at a signed Content-Length takes it; the completion does not."""
    upload = service.announce(10)
    with service.catalog.reading() as session:
        row = uploads.get(session, upload["id"])
    unsized = service.store.presign_part(row.object_key, row.s3_upload_id, 1, 60)
    assert httpx.put(unsized, content=bytes(11)).is_success
    path = f"/v1/uploads/{upload['id']}"
    document = service.refused(service.http.post(f"{path}/complete", json={}), 422, "wrong-size")
    assert "11 bytes, 10 were announced" in document["detail"]
    assert service.http.get(path).json()["state"] == "aborted"


def test_an_upload_goes_on_after_its_client_died(service):
    """All that is left is the upload's id: the rest is asked for, and only what is missing is sent."""
    data = tar_of(blob=bytes(range(256)) * 4096 * 12)
    upload = service.announce(len(data), "night.tar")
    sent = upload["parts"][1]
    body = data[upload["part_size"] : 2 * upload["part_size"]]
    assert httpx.put(sent["url"], content=body).is_success

    path = f"/v1/uploads/{upload['id']}"
    assert upload["id"] in [
        left["id"] for left in service.http.get("/v1/uploads", params={"state": "open"}).json()["items"]
    ]
    progress = service.http.get(path).json()
    (received,) = progress["received"]
    assert received == {"number": 2, "size": len(body), "etag": hashlib.md5(body).hexdigest()}
    missing = sorted(set(range(1, progress["part_count"] + 1)) - {2})
    answer = service.http.post(f"{path}/parts", json={"numbers": missing})
    assert answer.status_code == 200, answer.text
    assert [part["number"] for part in answer.json()["parts"]] == missing
    service.put_parts(answer.json(), data)
    answer = service.http.post(f"{path}/complete", json={"sha256": hashlib.sha256(data).hexdigest()})
    assert answer.status_code == 202, answer.text
    assert service.http.get(path).json()["state"] == "complete"
    service.refused(service.http.post(f"{path}/parts", json={"numbers": [1]}), 409, "upload-closed")


def test_an_upload_that_was_joined_and_not_recorded_says_so_and_is_completed(service):
    """The API was killed between the store's work and its own commit."""
    data = tar_of(blob=bytes(12 * MiB))
    upload = service.announce(len(data))
    service.put_parts(upload, data)
    path = f"/v1/uploads/{upload['id']}"
    assert service.http.get(path).json()["joined"] is False
    with service.catalog.reading() as session:
        row = uploads.get(session, upload["id"])
    arrived = service.store.list_parts(row.object_key, row.s3_upload_id)
    service.store.complete_multipart(row.object_key, row.s3_upload_id, arrived)
    progress = service.http.get(path).json()
    assert (progress["state"], progress["joined"], progress["received"]) == ("open", True, [])
    assert service.http.post(f"{path}/complete", json={}).status_code == 202
    progress = service.http.get(path).json()
    assert (progress["state"], progress["joined"]) == ("complete", False)


def test_an_upload_is_not_completed_before_all_has_arrived(service):
    data = tar_of(blob=bytes(12 * MiB))
    upload = service.announce(len(data))
    service.put_parts({**upload, "parts": upload["parts"][:2]}, data)
    path = f"/v1/uploads/{upload['id']}"
    document = service.refused(service.http.post(f"{path}/complete", json={}), 422, "invalid-parts")
    assert "1 of 3 parts have not arrived: 3" in document["detail"]
    service.put_parts({**upload, "parts": upload["parts"][2:]}, data)
    assert service.http.post(f"{path}/complete", json={}).status_code == 202


@pytest.mark.parametrize("numbers", [[], [0], [4], [1, 10_001], ["x"]])
def test_urls_are_given_for_parts_that_there_are(service, numbers):
    upload = service.announce(12 * MiB)
    answer = service.http.post(f"/v1/uploads/{upload['id']}/parts", json={"numbers": numbers})
    assert answer.status_code == 422 and answer.json()["errors"][0]["where"].startswith("numbers")
    service.http.delete(f"/v1/uploads/{upload['id']}")


def test_a_file_s_name_is_nowhere_in_the_store(service):
    upload = service.announce(10, "..%2f..%2fetc passwd #1?.tar")
    with service.catalog.reading() as session:
        row = uploads.get(session, upload["id"])
    assert (row.filename, row.object_key) == ("..%2f..%2fetc passwd #1?.tar", f"uploads/{row.id}/archive")
    service.http.delete(f"/v1/uploads/{upload['id']}")


@pytest.mark.parametrize("name", ["../../etc/passwd.tar", "a\\b.zip"])
def test_a_file_s_name_has_no_folders_in_it(service, name, nothing_kept):
    asked = {"kind": "drive", "filename": name, "size": 10}
    document = service.refused(service.http.post("/v1/uploads", json=asked), 422, "invalid-request")
    assert document["errors"][0]["where"] == "filename"
    assert "leave its folders out" in document["detail"]


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
