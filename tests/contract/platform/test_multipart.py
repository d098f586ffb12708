"""Multipart uploads that are looked into, go on after an interruption, or were forgotten; on both stores."""

import hashlib
import os
from datetime import UTC, datetime, timedelta

import httpx
import pytest

from l3ps_platform.errors import UploadError
from l3ps_platform.objects import DirectoryStore, ObjectStore, Part
from l3ps_platform.settings import MiB

KEY = "uploads/u/archive"


def test_what_has_arrived_is_told_by_number_size_and_md5(store: ObjectStore) -> None:
    upload = store.create_multipart(KEY)
    assert list(store.list_parts(KEY, upload)) == []
    for number, body in ((3, b"three"), (1, b"one" * MiB)):
        assert httpx.put(store.presign_part(KEY, upload, number, 60), content=body).is_success
    told = {1: hashlib.md5(b"one" * MiB).hexdigest(), 3: hashlib.md5(b"three").hexdigest()}
    assert list(store.list_parts(KEY, upload)) == [Part(1, told[1], 3 * MiB), Part(3, told[3], 5)]


def test_an_upload_goes_on_from_what_has_arrived(store: ObjectStore) -> None:
    """With new URLs, after the client and its list of etags are gone."""
    upload = store.create_multipart(KEY)
    bodies = {1: b"1" * 5 * MiB, 2: b"2" * 5 * MiB, 3: b"three"}
    httpx.put(store.presign_part(KEY, upload, 2, 60), content=bodies[2])
    missing = set(bodies) - {part.number for part in store.list_parts(KEY, upload)}
    assert missing == {1, 3}
    for number in missing:
        httpx.put(store.presign_part(KEY, upload, number, 60), content=bodies[number])
    store.complete_multipart(KEY, upload, store.list_parts(KEY, upload))
    assert store.get_bytes(KEY) == b"".join(bodies.values())


@pytest.mark.parametrize("length", [99, 101, 0])
def test_a_part_of_another_size_than_announced_is_refused(store: ObjectStore, length: int) -> None:
    upload = store.create_multipart(KEY)
    url = store.presign_part(KEY, upload, 1, 60, size=100)
    assert httpx.put(url, content=bytes(length)).status_code == 403
    assert list(store.list_parts(KEY, upload)) == []
    assert httpx.put(url, content=bytes(100)).status_code == 200
    assert [part.size for part in store.list_parts(KEY, upload)] == [100]


def test_parts_of_an_unknown_upload(store: ObjectStore) -> None:
    upload = store.create_multipart(KEY)
    store.abort_multipart(KEY, upload)
    for id in (upload, "0" * 32):
        with pytest.raises(UploadError, match="begin a new one"):
            store.list_parts(KEY, id)


def test_uploads_in_progress_are_listed_with_their_age(store: ObjectStore) -> None:
    began = datetime.now(UTC) - timedelta(seconds=5)
    first, second, third = (store.create_multipart(f"uploads/{name}/archive") for name in "abc")
    store.abort_multipart("uploads/b/archive", second)
    httpx.put(store.presign_part("uploads/c/archive", third, 1, 60), content=b"all")
    store.complete_multipart("uploads/c/archive", third, store.list_parts("uploads/c/archive", third))
    (pending,) = store.list_multipart()
    assert (pending.key, pending.upload_id) == ("uploads/a/archive", first)
    assert began <= pending.begun <= datetime.now(UTC) + timedelta(seconds=5)


def test_a_part_that_comes_after_the_end_leaves_nothing(tmp_path) -> None:
    """The folder store: an upload given up while a part of it is on its way."""
    store = DirectoryStore(tmp_path / "store", "")
    upload = store.create_multipart(KEY)
    grant = store.signer.verify("PUT", KEY, dict(httpx.URL(store.presign_part(KEY, upload, 1, 60)).params))
    with pytest.raises(UploadError, match="begin a new one"), store.receive(grant) as incoming:
        incoming.write(b"late")
        store.abort_multipart(KEY, upload)
    assert [path for path in store.root.rglob("*") if path.is_file() and path.name != "secret"] == []


def test_what_dead_processes_left_half_written_is_swept(tmp_path) -> None:
    store = DirectoryStore(tmp_path / "store", "")
    store.put_bytes("kept", b"x")
    old, new = store.root / "tmp" / "old", store.root / "tmp" / "new"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    assert store.tidy(datetime.now(UTC) - timedelta(days=1)) == 1
    assert [path.name for path in (store.root / "tmp").iterdir()] == ["new"]
    assert store.get_bytes("kept") == b"x"
