"""Multipart uploads that are looked into, go on after an interruption, or were forgotten; on both stores."""

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import httpx
import pytest

from l3ps_platform.errors import UploadError
from l3ps_platform.objects import DirectoryStore, ObjectStore, Part
from l3ps_platform.settings import MiB

KEY = "uploads/u/archive"


def test_what_has_arrived_is_told_by_number_size_and_md5(store: ObjectStore) -> None:
    upload = store.create_multipart(KEY, 5 * MiB)
    assert list(store.list_parts(KEY, upload)) == []
    for number, body in ((3, b"three"), (1, b"one" * MiB)):
        assert httpx.put(store.presign_part(KEY, upload, number, 60), content=body).is_success
    told = {1: hashlib.md5(b"one" * MiB).hexdigest(), 3: hashlib.md5(b"three").hexdigest()}
    assert list(store.list_parts(KEY, upload)) == [Part(1, told[1], 3 * MiB), Part(3, told[3], 5)]


def test_an_upload_goes_on_from_what_has_arrived(store: ObjectStore) -> None:
    """With new URLs, after the client and its list of etags are gone."""
    upload = store.create_multipart(KEY, 5 * MiB)
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
    upload = store.create_multipart(KEY, 5 * MiB)
    url = store.presign_part(KEY, upload, 1, 60, size=100)
    assert httpx.put(url, content=bytes(length)).status_code == 403
    assert list(store.list_parts(KEY, upload)) == []
    assert httpx.put(url, content=bytes(100)).status_code == 200
    assert [part.size for part in store.list_parts(KEY, upload)] == [100]


def test_parts_of_an_unknown_upload(store: ObjectStore) -> None:
    upload = store.create_multipart(KEY, 5 * MiB)
    store.abort_multipart(KEY, upload)
    for id in (upload, "0" * 32):
        with pytest.raises(UploadError, match="begin a new one"):
            store.list_parts(KEY, id)


def test_uploads_in_progress_are_listed_with_their_age(store: ObjectStore) -> None:
    began = datetime.now(UTC) - timedelta(seconds=5)
    first, second, third = (store.create_multipart(f"uploads/{name}/archive", 5 * MiB) for name in "abc")
    store.abort_multipart("uploads/b/archive", second)
    httpx.put(store.presign_part("uploads/c/archive", third, 1, 60), content=b"all")
    store.complete_multipart("uploads/c/archive", third, store.list_parts("uploads/c/archive", third))
    (pending,) = store.list_multipart()
    assert (pending.key, pending.upload_id) == ("uploads/a/archive", first)
    assert began <= pending.begun <= datetime.now(UTC) + timedelta(seconds=5)


def test_a_part_that_comes_after_the_end_leaves_nothing(tmp_path) -> None:
    """The folder store: an upload given up while a part of it is on its way."""
    store = DirectoryStore(tmp_path / "store", "")
    upload = store.create_multipart(KEY, 5 * MiB)
    grant = store.signer.verify("PUT", KEY, dict(httpx.URL(store.presign_part(KEY, upload, 1, 60)).params))
    with pytest.raises(UploadError, match="begin a new one"), store.receive(grant) as incoming:
        incoming.write(b"late")
        store.abort_multipart(KEY, upload)
    assert [path for path in store.root.rglob("*") if path.is_file() and path.name != "secret"] == []


def put(store: DirectoryStore, upload: str, number: int, body: bytes) -> None:
    """What the API does with the body of a part's URL."""
    grant = store.signer.verify("PUT", KEY, dict(httpx.URL(store.presign_part(KEY, upload, number, 60)).params))
    with store.receive(grant) as incoming:
        incoming.write(body)


@pytest.fixture
def folder(tmp_path) -> DirectoryStore:
    """A store in a folder, without an API before it."""
    return DirectoryStore(tmp_path / "store", "")


def test_joining_copies_nothing(folder) -> None:
    """A copy of the largest upload would outlast every client's patience, and take its size of the disk again."""
    upload = folder.create_multipart(KEY, 4)
    for number, body in ((3, b"9"), (1, b"1234"), (2, b"5678")):
        put(folder, upload, number, body)
    (data,) = (folder.root / "multipart").glob("*/data")
    before = data.stat().st_ino
    folder.complete_multipart(KEY, upload, folder.list_parts(KEY, upload))
    assert folder.get_bytes(KEY) == b"123456789"
    assert folder.path_of(KEY).stat().st_ino == before
    assert list((folder.root / "multipart").iterdir()) == list((folder.root / "tmp").iterdir()) == []


def test_a_last_part_sent_again_shorter_leaves_nothing_of_the_longer(folder) -> None:
    upload = folder.create_multipart(KEY, 4)
    for number, body in ((2, b"5678"), (1, b"1234"), (2, b"x")):
        put(folder, upload, number, body)
    folder.complete_multipart(KEY, upload, folder.list_parts(KEY, upload))
    assert folder.get_bytes(KEY) == b"1234x"


def test_a_short_part_before_others_is_not_joined(folder) -> None:
    upload = folder.create_multipart(KEY, 4)
    put(folder, upload, 1, b"123")
    put(folder, upload, 2, b"5678")
    with pytest.raises(UploadError, match="part 1 has 3 bytes, all but the last have 4"):
        folder.complete_multipart(KEY, upload, folder.list_parts(KEY, upload))
    with pytest.raises(UploadError, match="more than the 4"):
        put(folder, upload, 1, b"12345")
    put(folder, upload, 1, b"1234")
    folder.complete_multipart(KEY, upload, folder.list_parts(KEY, upload))
    assert folder.get_bytes(KEY) == b"12345678"


def test_parts_sent_twice_at_once_are_whole(folder) -> None:
    """Whichever of two equal numbers comes last, its bytes and its etag belong together, and its neighbours' too."""
    size = MiB
    upload = folder.create_multipart(KEY, size)
    bodies = [(1 + n % 4, bytes([n]) * size) for n in range(16)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda one: put(folder, upload, *one), bodies))
    arrived = folder.list_parts(KEY, upload)
    assert [part.number for part in arrived] == [1, 2, 3, 4]
    folder.complete_multipart(KEY, upload, arrived)
    whole = folder.get_bytes(KEY)
    joined = [whole[n * size : (n + 1) * size] for n in range(4)]
    assert [hashlib.md5(part).hexdigest() for part in joined] == [part.etag for part in arrived]


def test_a_join_that_was_cut_off_after_the_object_was_made_is_over(folder, monkeypatch) -> None:
    upload = folder.create_multipart(KEY, 4)
    put(folder, upload, 1, b"1234")
    arrived = folder.list_parts(KEY, upload)
    with monkeypatch.context() as patch, pytest.raises(InterruptedError):
        patch.setattr(folder._uploads, "drop", interrupted)
        folder.complete_multipart(KEY, upload, arrived)
    for act in (
        lambda: folder.list_parts(KEY, upload),
        lambda: folder.complete_multipart(KEY, upload, arrived),
        lambda: put(folder, upload, 1, b"5678"),
    ):
        with pytest.raises(UploadError, match="begin a new one"):
            act()
    assert folder.get_bytes(KEY) == b"1234"
    folder.abort_multipart(KEY, upload)
    assert list((folder.root / "multipart").iterdir()) == []


def interrupted(*_) -> None:
    """The process dies here."""
    raise InterruptedError


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
