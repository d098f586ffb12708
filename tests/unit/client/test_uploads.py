"""Files on their way up: in parts, checked, gone on with after a death, and nothing left of what was refused."""

import fcntl
import hashlib
import os
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack

import pytest

from l3ps_client import Client, Conflict, Damaged, InvalidRequest, NotFound, Refused, Retry, Unreachable
from l3ps_client._ledger import Ledger

AT_ONCE = Retry(first=0.0)
PARTS = 6
DOWN = (503, {"detail": "The object store does not answer."}, {"Retry-After": "0"})
BUSY = (409, {"type": "urn:l3ps:problem:request-in-progress", "detail": "In progress."}, {"Retry-After": "0"})


@pytest.fixture
def file(service, tmp_path):
    """A file of five whole parts and a bit."""
    path = tmp_path / "morning.tar"
    path.write_bytes(os.urandom((PARTS - 1) * service.PART + 100))
    return path


@pytest.fixture
def client(service, tmp_path):
    with Client(service.url, "s3cret", retry=AT_ONCE, state=tmp_path / "notes") as client:
        yield client


def notes(tmp_path) -> list:
    return list((tmp_path / "notes").iterdir())


def only(condition, answer):
    """A fault for requests that meet a condition on (method, path)."""
    return lambda method, path: answer if condition(method, path) else None


def part(number):
    return lambda method, path: method == "PUT" and f"/{number}?" in path


def test_a_file_arrives_whole_with_its_checksum_and_leaves_no_note(service, client, file, tmp_path):
    told = []
    assert client.drives.upload(file, name="morning", progress=lambda *bytes: told.append(bytes))["id"] == "drv_1"
    upload = service.uploads["upl_1"]
    assert service.whole("upl_1") == file.read_bytes()
    assert upload["announced"] == {"kind": "drive", "filename": "morning.tar", "size": file.stat().st_size}
    assert upload["completion"]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert upload["completion"]["name"] == "morning"
    assert [tag["number"] for tag in upload["completion"]["parts"]] == list(range(1, PARTS + 1))
    assert told[-1] == (file.stat().st_size,) * 2 and told == sorted(told)
    assert notes(tmp_path) == []


def test_parts_go_without_the_token(service, client, file):
    with_token = []
    original = service._done

    def look(handler, path, body):
        if handler.headers.get("authorization"):
            with_token.append(handler.command)
        return original(handler, path, body)

    service._done = look
    client.drives.upload(file)
    assert "PUT" not in with_token and "POST" in with_token


def test_a_part_that_fails_starts_over_and_is_counted_once(service, client, file):
    failures = [DOWN]
    service.faults.append(lambda method, path: failures.pop() if part(3)(method, path) and failures else None)
    told = []
    client.drives.upload(file, progress=lambda done, total: told.append(done))
    assert service.puts().count(3) == 2
    assert service.whole("upl_1") == file.read_bytes()
    assert told[-1] == max(told) == file.stat().st_size


def test_a_part_that_arrives_damaged_is_sent_again(service, client, file):
    wrong = [(200, None, {"ETag": '"00000000000000000000000000000000"'})]
    service.faults.append(lambda method, path: wrong.pop() if part(2)(method, path) and wrong else None)
    client.drives.upload(file)
    assert service.puts().count(2) == 2


def test_a_part_that_arrives_damaged_twice_ends_the_upload_and_nothing_is_kept(service, client, file, tmp_path):
    service.faults.append(only(part(2), (200, None, {"ETag": f'"{"0" * 32}"'})))
    with pytest.raises(Damaged, match="Part 2"):
        client.drives.upload(file)
    assert service.uploads["upl_1"]["state"] == "aborted"
    assert notes(tmp_path) == []


def test_etags_that_are_no_md5_are_taken_as_they_are(service, client, file):
    service.faults.append(only(part(2), (200, None, {"ETag": '"an-opaque-tag"'})))
    client.drives.upload(file)
    assert service.uploads["upl_1"]["completion"]["parts"][1] == {"number": 2, "etag": "an-opaque-tag"}


def test_expired_urls_are_asked_for_again(service, client, file):
    def expire(method, path):
        if part(4)(method, path):
            service.signature = "2"

    service.faults.append(expire)
    client.drives.upload(file, parallel=1)
    assert service.whole("upl_1") == file.read_bytes()
    assert ("POST", "/v1/uploads/upl_1/parts") in service.seen


def test_what_is_refused_leaves_no_open_upload_and_no_note(service, client, file, tmp_path):
    refusal = 422, {"detail": "It is no archive.", "errors": []}
    service.faults.append(only(lambda _, path: path.endswith("/complete"), refusal))
    with pytest.raises(InvalidRequest, match="no archive"):
        client.drives.upload(file)
    assert service.uploads["upl_1"]["state"] == "aborted"
    assert notes(tmp_path) == []


def test_an_announcement_that_is_refused_leaves_no_note(service, client, file, tmp_path):
    service.faults.append(only(lambda method, path: path == "/v1/uploads", (413, {"detail": "Too large."})))
    with pytest.raises(InvalidRequest):
        client.drives.upload(file)
    assert notes(tmp_path) == []


def test_an_interrupted_upload_goes_on_with_what_is_missing(service, client, file, tmp_path):
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable, match="object store"):
        client.drives.upload(file, name="morning", parallel=1)
    assert service.uploads["upl_1"]["state"] == "open"
    (facts,) = client.uploads.unfinished(file)
    assert (facts["upload_id"], facts["name"]) == ("upl_1", "morning")

    service.faults.clear()
    service.seen.clear()
    service.signature = "2"  # a note holds no URL, and those of the day before are of no use
    with Client(service.url, retry=AT_ONCE, state=tmp_path / "notes") as other:
        told = []
        assert other.drives.upload(file, name="morning", progress=lambda done, _: told.append(done))["id"] == "drv_1"
    assert sorted(service.puts()) == [5, 6]
    assert service.whole("upl_1") == file.read_bytes()
    assert told[-1] == file.stat().st_size
    assert notes(tmp_path) == []


def test_a_note_tells_no_secret(service, client, file, tmp_path):
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file)
    (note,) = notes(tmp_path)
    assert note.stat().st_mode & 0o777 == 0o600
    assert "s3cret" not in note.read_text() and "/part/" not in note.read_text()


def test_a_part_that_the_service_has_got_wrong_is_sent_again(service, client, file):
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file, parallel=1)
    service.faults.clear()
    service.seen.clear()
    service.uploads["upl_1"]["parts"][2] = bytes(service.PART)
    client.drives.upload(file)
    assert sorted(service.puts()) == [2, 5, 6]


def test_equal_bytes_in_another_file_go_on_where_the_checksum_says_so(service, client, file, tmp_path):
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file, sha256=sha256, parallel=1)
    service.faults.clear()
    service.seen.clear()
    copy = tmp_path / "packed-again.tar"
    copy.write_bytes(file.read_bytes())
    client.drives.upload(copy, sha256=sha256)
    assert sorted(service.puts()) == [5, 6]


def test_a_file_that_was_written_anew_is_another_upload(service, client, file):
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file)
    service.faults.clear()
    file.write_bytes(os.urandom(service.PART))
    client.drives.upload(file)
    assert service.uploads["upl_2"]["state"] == "complete"


@pytest.mark.parametrize("gone", ["unknown", "aborted"])
def test_an_upload_that_the_service_has_given_up_begins_anew(service, client, file, gone):
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file)
    service.faults.clear()
    service.uploads["upl_1"]["state"] = gone
    if gone == "unknown":
        service.uploads["old"] = service.uploads.pop("upl_1")
    client.drives.upload(file)
    assert service.whole("upl_2") == file.read_bytes()


def test_an_upload_that_is_complete_is_not_sent_again(service, client, file):
    service.faults.append(only(lambda _, path: path.endswith("/complete"), (503, {}, {"Retry-After": "0"})))
    with pytest.raises(Unreachable):
        client.drives.upload(file)
    service.faults.clear()
    service.seen.clear()
    service.uploads["upl_1"]["state"] = "complete"
    service.faults.append(only(lambda _, path: path == "/v1/drives/None", (200, {"id": "drv_1"})))
    assert client.drives.upload(file) == {"id": "drv_1"}
    assert service.puts() == []


def test_an_upload_that_was_joined_and_not_recorded_is_completed_and_not_sent_again(service, client, file):
    """The service was killed between the store's work and its own commit."""
    service.faults.append(only(lambda _, path: path.endswith("/complete"), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file, name="morning")
    service.faults.clear()
    service.seen.clear()
    service.uploads["upl_1"]["joined"] = True
    told = []
    assert client.drives.upload(file, name="morning", progress=lambda *done: told.append(done))["id"] == "drv_1"
    assert service.puts() == []
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    assert service.uploads["upl_1"]["completion"] == {"name": "morning", "sha256": sha256}
    assert told == [(file.stat().st_size,) * 2]


def test_a_completion_that_takes_long_is_waited_for(service, client, file):
    """Its answer is lost to a proxy's patience; the service says that it is still at it, more often than one tries."""
    answers = [BUSY] * 20 + [(504,)]
    service.faults.append(lambda _, path: answers.pop() if path.endswith("/complete") and answers else None)
    assert client.drives.upload(file)["id"] == "drv_1"
    assert not [path for method, path in service.seen if method == "DELETE"]


def test_a_completion_that_takes_too_long_is_left_for_the_next_call(service, file, tmp_path):
    service.faults.append(only(lambda _, path: path.endswith("/complete"), BUSY))
    hasty = Retry(first=0.0, in_progress=0.0)
    with Client(service.url, retry=hasty, state=tmp_path / "notes") as client:
        with pytest.raises(Conflict):
            client.drives.upload(file)
        assert service.uploads["upl_1"]["state"] == "open"
        service.faults.clear()
        assert client.drives.upload(file)["id"] == "drv_1"
    assert service.whole("upl_1") == file.read_bytes() and len(service.puts()) == PARTS


def test_an_announcement_in_progress_elsewhere_is_found_by_the_next_call(service, file, tmp_path):
    """Its process was killed after the commit, and its lease is longer than a client cares to wait."""
    original = service._done

    def die(handler, path, body):
        answer = original(handler, path, body)
        return BUSY if path == "/v1/uploads" else answer

    service._done = die
    hasty = Retry(first=0.0, in_progress=0.0)
    with Client(service.url, retry=hasty, state=tmp_path / "notes") as client:
        with pytest.raises(Conflict):
            client.drives.upload(file)
        service._done = original
        client.drives.upload(file)
    assert list(service.uploads) == ["upl_1"]


@pytest.mark.parametrize("status", [401, 403, 408, 421])
@pytest.mark.parametrize("where", ["PUT", "complete"])
def test_what_is_no_fault_of_the_upload_keeps_what_has_arrived(service, client, file, tmp_path, status, where):
    """Such as a key that was revoked or rotated in the middle of it."""
    at = part(6) if where == "PUT" else lambda method, path: path.endswith("/complete")
    service.faults.append(only(lambda method, path: at(method, path) or path.endswith("/parts"), (status, {})))
    with pytest.raises(Refused):
        client.drives.upload(file, parallel=1)
    assert service.uploads["upl_1"]["state"] == "open" and notes(tmp_path)
    service.faults.clear()
    service.seen.clear()
    client.drives.upload(file)
    assert service.whole("upl_1") == file.read_bytes()
    assert service.puts() == ([6] if where == "PUT" else [])


def test_parts_that_are_missing_at_the_completion_are_sent_by_the_next_call(service, client, file):
    missing = 422, {"type": "urn:l3ps:problem:invalid-parts", "detail": "1 of 6 parts have not arrived: 3."}
    service.faults.append(only(lambda _, path: path.endswith("/complete"), missing))
    with pytest.raises(InvalidRequest):
        client.drives.upload(file)
    service.faults.clear()
    service.seen.clear()
    del service.uploads["upl_1"]["parts"][3]
    client.drives.upload(file)
    assert service.puts() == [3] and service.whole("upl_1") == file.read_bytes()


def test_interrupted_with_abort_on_error_nothing_stays(service, client, file, tmp_path):
    service.faults.append(only(part(5), DOWN))
    with pytest.raises(Unreachable):
        client.drives.upload(file, abort_on_error=True)
    assert service.uploads["upl_1"]["state"] == "aborted"
    assert notes(tmp_path) == []


def test_without_a_place_for_notes_an_interrupted_upload_is_given_up(service, file):
    service.faults.append(only(part(5), DOWN))
    with Client(service.url, retry=AT_ONCE, state=None) as client, pytest.raises(Unreachable):
        client.drives.upload(file)
    assert service.uploads["upl_1"]["state"] == "aborted"


def test_a_file_that_changes_meanwhile_is_not_sent(service, client, file, tmp_path):
    def change(method, path):
        if part(3)(method, path):
            os.utime(file, (1, 1))

    service.faults.append(change)
    with pytest.raises(Damaged, match="changed"):
        client.drives.upload(file)
    assert service.uploads["upl_1"]["state"] == "aborted"


def test_an_upload_that_ended_at_the_store_is_a_refusal(service, client, file):
    service.faults.append(only(part(5), (404, None, {}, b"<Code>NoSuchUpload</Code>")))
    with pytest.raises(NotFound):
        client.drives.upload(file)
    assert service.uploads["upl_1"]["state"] == "aborted"


def test_two_processes_with_the_same_file_do_not_share_an_upload(service, client, file, tmp_path):
    here, go = threading.Event(), threading.Event()

    def hold(method, path):
        if part(1)(method, path) and "upl_1" in path:
            here.set()
            service._lock.release()
            go.wait(30)
            service._lock.acquire()

    service.faults.append(hold)
    first = threading.Thread(target=client.drives.upload, args=(file,))
    first.start()
    assert here.wait(30)
    with Client(service.url, retry=AT_ONCE, state=tmp_path / "notes") as other:
        other.drives.upload(file)
    go.set()
    first.join(30)
    assert service.whole("upl_1") == service.whole("upl_2") == file.read_bytes()


def test_a_note_that_another_process_deletes_in_this_moment_is_made_anew(tmp_path, monkeypatch):
    """The other one ends between our opening and our locking the file: what we lock must be the file that is there."""
    ledger, flock = Ledger(tmp_path), fcntl.flock
    with ExitStack() as other:
        other.enter_context(ledger.note(file="morning.tar"))

        def late(file, how):
            monkeypatch.undo()
            other.close()
            flock(file, how)

        monkeypatch.setattr(fcntl, "flock", late)
        with ledger.note(file="morning.tar") as note:
            assert note.lasting
            note.save(path=str(tmp_path / "morning.tar"), upload_id="upl_1")
            with ledger.note(file="morning.tar") as third:
                assert not third.lasting
        assert ledger.of_file(tmp_path / "morning.tar") == [note.facts]


def test_a_killed_process_leaves_a_note_and_the_next_one_goes_on(service, client, file, tmp_path):
    """kill -9 while part 4 is on its way: parts 1 to 3 are not sent again."""
    code = (
        "import sys, l3ps_client, pathlib\n"
        "url, file, state = sys.argv[1:]\n"
        "with l3ps_client.Client(url, state=pathlib.Path(state)) as client:\n"
        "    client.drives.upload(file, parallel=1)\n"
    )
    arrived, killed = threading.Event(), threading.Event()

    def hold(method, path):
        if part(4)(method, path) and not killed.is_set():
            arrived.set()
            killed.wait(30)
            return 503, {}, {}
        return None

    service.faults.append(hold)
    process = subprocess.Popen([sys.executable, "-c", code, service.url, str(file), str(tmp_path / "notes")])
    assert arrived.wait(30)
    process.send_signal(signal.SIGKILL)
    assert process.wait(30) == -signal.SIGKILL
    service.seen.clear()
    killed.set()
    assert client.drives.upload(file)["id"] == "drv_1"
    assert len(service.uploads) == 1
    assert not {1, 2, 3} & set(service.puts())
    assert service.whole("upl_1") == file.read_bytes()


def test_ctrl_c_ends_a_process_between_two_parts_and_the_next_one_goes_on(service, client, file, tmp_path):
    code = (
        "import sys, l3ps_client, pathlib\n"
        "url, file, state = sys.argv[1:]\n"
        "with l3ps_client.Client(url, state=pathlib.Path(state)) as client:\n"
        "    try:\n"
        "        client.drives.upload(file, parallel=1)\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(130)\n"
    )
    arrived, stopped = threading.Event(), threading.Event()

    def hold(method, path):
        if method != "PUT" or service.puts()[-1] < 4:
            return None
        arrived.set()
        stopped.wait(30)
        return 503, {}, {"Retry-After": "5"}

    service.faults.append(hold)
    process = subprocess.Popen([sys.executable, "-c", code, service.url, str(file), str(tmp_path / "notes")])
    assert arrived.wait(30)
    process.send_signal(signal.SIGINT)
    stopped.set()
    assert process.wait(30) == 130
    assert service.uploads["upl_1"]["state"] == "open"
    service.faults.clear()
    client.drives.upload(file)
    assert list(service.uploads) == ["upl_1"] and service.whole("upl_1") == file.read_bytes()


def test_killed_between_announcement_and_answer_the_same_upload_is_used(service, client, file):
    """The key is noted before the announcement leaves, so the next process gets the upload that was opened."""
    service.faults.append(only(lambda method, path: path == "/v1/uploads" and service.uploads, DOWN))
    original = service._done

    def lose_the_answer(handler, path, body):
        answer = original(handler, path, body)
        return (502,) if path == "/v1/uploads" else answer

    service._done = lose_the_answer
    with pytest.raises(Unreachable):
        client.drives.upload(file)
    service._done = original
    service.faults.clear()
    client.drives.upload(file)
    assert list(service.uploads) == ["upl_1"]


def test_retries_are_bounded(service, file, tmp_path):
    service.faults.append(only(part(1), DOWN))
    with Client(service.url, retry=Retry(tries=2, first=0.0), state=tmp_path) as client, pytest.raises(Unreachable):
        client.drives.upload(file, parallel=1)
    assert service.puts() == [1, 1, 1, 1]
