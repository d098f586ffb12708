"""What every object store promises, tried on a directory and on a real MinIO."""

import threading
from pathlib import Path

import httpx
import pytest

from l3ps_platform.errors import InvalidKey, ObjectMissing, StoreUnavailable, UploadError
from l3ps_platform.objects import DirectoryStore, ObjectStore, Part, open_store
from l3ps_platform.settings import MiB, Settings


def test_bytes_come_back(store: ObjectStore) -> None:
    store.put_bytes("a/b.json", b"{}")
    assert store.get_bytes("a/b.json") == b"{}"
    with store.open("a/b.json") as stream:
        assert stream.read() == b"{}"


def test_a_second_put_replaces(store: ObjectStore) -> None:
    store.put_bytes("a", b"first")
    store.put_bytes("a", b"second")
    assert store.get_bytes("a") == b"second"
    assert store.stat("a").size == 6


def test_empty_object(store: ObjectStore) -> None:
    store.put_bytes("empty", b"")
    assert store.get_bytes("empty") == b""
    assert store.stat("empty").size == 0


def test_range(store: ObjectStore) -> None:
    store.put_bytes("a", b"0123456789")
    assert store.get_bytes("a", 3) == b"3456789"
    assert store.get_bytes("a", 3, 2) == b"34"
    assert store.get_bytes("a", 3, 0) == b""
    assert store.get_bytes("a", 8, 100) == b"89"


def test_large_file_both_ways(store: ObjectStore, tmp_path: Path) -> None:
    """Larger than one part of the S3 client (5 MiB)."""
    source = tmp_path / "source"
    source.write_bytes(bytes(range(256)) * 4096 * 12)
    store.put_file("drives/big.zip", source)
    store.get_file("drives/big.zip", tmp_path / "target")
    assert (tmp_path / "target").read_bytes() == source.read_bytes()
    assert [p.name for p in tmp_path.glob("target*")] == ["target"]


@pytest.mark.parametrize("read", ["get_bytes", "stat", "open", "get_file"])
def test_missing_object(store: ObjectStore, read: str, tmp_path: Path) -> None:
    with pytest.raises(ObjectMissing, match="no/such") as caught:
        if read == "open":
            with store.open("no/such"):
                pass
        elif read == "get_file":
            store.get_file("no/such", tmp_path / "target")
        else:
            getattr(store, read)("no/such")
    assert caught.value.key == "no/such"
    assert not store.exists("no/such")
    assert not list(tmp_path.glob("target*"))


def test_list_is_complete_ordered_and_bounded_by_the_prefix(store: ObjectStore) -> None:
    keys = ["a/1", "a/10", "a/2", "a/b/c", "ab/1", "b"]
    for key in reversed(keys):
        store.put_bytes(key, key.encode())
    assert [info.key for info in store.list()] == keys
    assert [info.key for info in store.list("a/")] == ["a/1", "a/10", "a/2", "a/b/c"]
    assert [info.size for info in store.list("a/b/")] == [5]
    assert list(store.list("nothing/")) == []


def test_delete_is_idempotent(store: ObjectStore) -> None:
    store.put_bytes("a/b", b"x")
    store.delete("a/b")
    store.delete("a/b")
    assert not store.exists("a/b")


def test_delete_prefix_spares_neighbours(store: ObjectStore) -> None:
    for key in ("a/1", "a/b/2", "ab"):
        store.put_bytes(key, b"x")
    assert store.delete_prefix("a/") == 2
    assert [info.key for info in store.list()] == ["ab"]


@pytest.mark.parametrize(
    "key", ["", "/etc/passwd", "../x", "a/../b", "a//b", "a/", ".hidden", "a\\b", "a b", "ä", "x" * 901]
)
def test_keys_that_could_leave_the_store_are_refused_by_every_method(
    store: ObjectStore, key: str, tmp_path: Path
) -> None:
    calls = [
        lambda: store.put_bytes(key, b""),
        lambda: store.put_file(key, Path(__file__)),
        lambda: store.get_bytes(key),
        lambda: store.get_file(key, tmp_path / "x"),
        lambda: store.stat(key),
        lambda: store.delete(key),
        lambda: store.presign_get(key, 60),
        lambda: store.presign_put(key, 60),
        lambda: store.create_multipart(key, 5 * MiB),
    ]
    for call in calls:
        with pytest.raises(InvalidKey):
            call()


def test_presigned_get_needs_no_credentials_and_names_the_file(store: ObjectStore) -> None:
    store.put_bytes("labels/x.npz", b"labels")
    reply = httpx.get(store.presign_get("labels/x.npz", 60, filename="scan 1.npz"))
    assert (reply.status_code, reply.content) == (200, b"labels")
    assert "scan%201.npz" in reply.headers["content-disposition"].replace("scan 1.npz", "scan%201.npz")


def test_presigned_put_stores_the_body(store: ObjectStore) -> None:
    assert httpx.put(store.presign_put("in/x", 60), content=b"body").status_code == 200
    assert store.get_bytes("in/x") == b"body"


@pytest.mark.parametrize("tamper", ["key", "method", "time"])
def test_presigned_urls_permit_only_what_they_say(store: ObjectStore, tamper: str) -> None:
    store.put_bytes("mine", b"mine")
    store.put_bytes("secret", b"secret")
    if tamper == "key":
        reply = httpx.get(store.presign_get("mine", 60).replace("/mine?", "/secret?"))
    elif tamper == "method":
        reply = httpx.put(store.presign_get("mine", 60), content=b"other")
    else:
        url = httpx.URL(store.presign_get("mine", 60))
        name = "X-Amz-Expires" if "X-Amz-Expires" in url.params else "expires"
        reply = httpx.get(url.copy_set_param(name, str(int(url.params[name]) + 1)))
    assert reply.status_code == 403
    assert store.get_bytes("mine") == b"mine"


def test_multipart_joins_parts_by_number(store: ObjectStore) -> None:
    """Uploaded and reported out of order, through presigned URLs, with the quotes S3 puts around etags."""
    upload = store.create_multipart("up/drive.zip", 5 * MiB)
    bodies = {1: b"1" * (5 * MiB), 2: b"2" * (5 * MiB), 3: b"three"}
    parts = []
    for number in (3, 1, 2):
        reply = httpx.put(store.presign_part("up/drive.zip", upload, number, 60), content=bodies[number])
        assert reply.status_code == 200
        parts.append(Part(number, reply.headers["etag"]))
    assert not store.exists("up/drive.zip")
    info = store.complete_multipart("up/drive.zip", upload, parts)
    assert info.size == sum(map(len, bodies.values()))
    assert store.get_bytes("up/drive.zip") == b"".join(bodies[n] for n in (1, 2, 3))


def test_a_part_uploaded_again_counts_the_last_time(store: ObjectStore) -> None:
    upload = store.create_multipart("up/x", 5 * MiB)
    etags = [httpx.put(store.presign_part("up/x", upload, 1, 60), content=b).headers["etag"] for b in (b"old", b"new")]
    with pytest.raises(UploadError):
        store.complete_multipart("up/x", upload, [Part(1, etags[0])])
    store.complete_multipart("up/x", upload, [Part(1, etags[1])])
    assert store.get_bytes("up/x") == b"new"


@pytest.mark.parametrize("parts", [[], [Part(1, "0" * 32)], [Part(2, "0" * 32)]], ids=["none", "wrong-etag", "missing"])
def test_parts_that_do_not_fit(store: ObjectStore, parts: list[Part]) -> None:
    upload = store.create_multipart("up/x", 5 * MiB)
    httpx.put(store.presign_part("up/x", upload, 1, 60), content=b"body")
    with pytest.raises(UploadError):
        store.complete_multipart("up/x", upload, parts)
    assert not store.exists("up/x")


def test_an_aborted_upload_is_gone(store: ObjectStore) -> None:
    upload = store.create_multipart("up/x", 5 * MiB)
    etag = httpx.put(store.presign_part("up/x", upload, 1, 60), content=b"body").headers["etag"]
    store.abort_multipart("up/x", upload)
    store.abort_multipart("up/x", upload)
    with pytest.raises(UploadError, match="begin a new one"):
        store.complete_multipart("up/x", upload, [Part(1, etag)])


def test_readers_see_whole_objects_while_one_is_replaced(store: ObjectStore) -> None:
    bodies = {b"a" * 300_000, b"b" * 200_000}
    store.put_bytes("x", b"a" * 300_000)
    stop = threading.Event()

    def write() -> None:
        while not stop.is_set():
            for body in bodies:
                store.put_bytes("x", body)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        assert {store.get_bytes("x") for _ in range(40)} <= bodies
    finally:
        stop.set()
        writer.join()


def test_a_dead_s3_server_is_unavailable(minio_server: str) -> None:
    """Refused connections and wrong credentials are both said in our words."""
    credentials = minio_server.rpartition("@")[0]
    with pytest.raises(StoreUnavailable, match="does not answer"):
        open_store(Settings(objects_url=f"s3://{credentials}@127.0.0.1:1/bucket?secure=0")).ping()
    host = minio_server.rpartition("@")[2]
    with pytest.raises(StoreUnavailable, match=r"refused|no bucket"):
        open_store(Settings(objects_url=f"s3://tester:wrong-secret@{host}/bucket?secure=0")).ping()
    with pytest.raises(StoreUnavailable, match="no bucket"):
        open_store(Settings(objects_url=f"s3://{minio_server}/not-there?secure=0")).ping()


def test_a_missing_directory_is_unavailable(tmp_path: Path) -> None:
    with pytest.raises(StoreUnavailable, match="missing or not writable"):
        DirectoryStore(tmp_path / "store", "").ping()


def test_public_endpoint_signs_for_the_name_clients_use(s3_url: str) -> None:
    """A signature covers the host, so the URL must be made for the name under which clients reach the server."""
    port = s3_url.rpartition("@")[2].split("/")[0].split(":")[1]
    store = open_store(Settings(objects_url=s3_url, objects_public_url=f"http://localhost:{port}"))
    store.ensure()
    store.put_bytes("x", b"body")
    url = store.presign_get("x", 60)
    assert url.startswith(f"http://localhost:{port}/")
    assert httpx.get(url).content == b"body"


def test_processes_share_the_directory_store_secret(tmp_path: Path) -> None:
    first, second = (DirectoryStore(tmp_path / "store", "http://api") for _ in range(2))
    url = httpx.URL(first.presign_get("x", 60))
    assert second.signer.verify("GET", "x", dict(url.params)).key == "x"
    assert (tmp_path / "store" / "secret").stat().st_mode & 0o077 == 0
