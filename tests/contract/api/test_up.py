"""``l3ps up`` as a user runs it: it comes up, it goes away whole, and nothing of it stays behind."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest
from tests.conftest import wait_until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")


class Up:
    """A running ``l3ps up``."""

    def __init__(self, data: Path, *options: str) -> None:
        command = [sys.executable, "-m", "l3ps_cli.main", "up", "--data", str(data), "--port", "0", *options]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            command, stdout=pipe, stderr=pipe, text=True, env=os.environ | {"COLUMNS": "400"}
        )
        self.data = data

    def wait_until_up(self) -> str:
        line = self.process.stdout.readline()
        assert line.startswith("l3ps is up at http://127.0.0.1:"), line + self.process.stderr.read()
        return line.split()[4]

    def descendants(self) -> set[int]:
        parents = {}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
            except (FileNotFoundError, ProcessLookupError):
                continue
        found = {self.process.pid}
        while more := {pid for pid, parent in parents.items() if parent in found} - found:
            found |= more
        return found - {self.process.pid}

    def wait_for_a_worker_child(self) -> set[int]:
        """All descendants once the worker has forked: Redis, the API, the worker and at least one of its children."""
        found: set[int] = wait_until(self.descendants, lambda found: len(found) >= 4)
        return found

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


@pytest.fixture
def up(tmp_path):
    started = []

    def start(*options: str) -> Up:
        started.append(Up(tmp_path / "my däta", *options))
        return started[-1]

    yield start
    for each in started:
        each.process.kill()
        each.process.communicate()


def alive(pids: set[int]) -> set[int]:
    """Those of the processes that run, after giving the kernel time to end them."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        running = set()
        for pid in pids:
            try:
                if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                    running.add(pid)
            except (FileNotFoundError, ProcessLookupError):
                continue
        if not running:
            return set()
        time.sleep(0.05)
    return running


def listens(port: int) -> bool:
    """Whether somebody listens there."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def assert_nothing_left(data: Path, pids: set[int], url: str) -> None:
    assert alive(pids) == set()
    # A killed process is a zombie as soon as its first thread has ended; its sockets close with the last.
    wait_until(lambda: not listens(int(url.rpartition(":")[2])), seconds=10)
    assert [path for path in data.rglob("*") if path.is_socket()] == []


def test_a_killed_up_leaves_no_process_and_the_next_one_goes_on_with_its_data_until_ctrl_c(up):
    killed = up()
    url = killed.wait_until_up()
    note = json.loads((killed.data / "up.json").read_text())
    assert note == {"url": url, "token": (killed.data / "token").read_text().strip(), "pid": killed.process.pid}
    assert {path.stat().st_mode & 0o777 for path in (killed.data / "up.json", killed.data / "token")} == {0o600}
    assert httpx.get(f"{url}/v1/drives").status_code == 401, "also on loopback"
    announced = {"kind": "drive", "filename": "a.tar", "size": 9}
    credentials = {"authorization": f"Bearer {note['token']}"}
    upload = httpx.post(f"{url}/v1/uploads", json=announced, headers=credentials).json()
    pids = killed.wait_for_a_worker_child()
    killed.process.kill()
    killed.process.communicate()
    assert_nothing_left(killed.data, pids, url)

    stack = up("--token", "s3cret")
    url = stack.wait_until_up()
    path = f"{url}/v1/uploads/{upload['id']}"
    assert httpx.get(path).status_code == 401
    assert httpx.get(path, headers={"authorization": "Bearer s3cret"}).json()["state"] == "open"

    code, _, complaint = up().end()
    assert code == 1
    assert f"already up on {stack.data}, at {url}" in complaint
    assert len(complaint.strip().splitlines()) == 1
    assert httpx.get(f"{url}/readyz").is_success, "the running one is not disturbed"

    pids = stack.wait_for_a_worker_child()
    stack.process.send_signal(signal.SIGINT)
    code, out, err = stack.end()
    assert code == 0, err
    assert "l3ps has stopped." in out
    assert "s3cret" not in out, "standard output is no terminal here"
    assert_nothing_left(stack.data, pids, url)
    assert not (stack.data / "up.json").exists()


def test_a_token_is_made_once_and_asked_for_unless_told_otherwise(up):
    unasked = up("--no-token", "--workers", "1")
    url = unasked.wait_until_up()
    assert json.loads((unasked.data / "up.json").read_text())["token"] is None
    assert httpx.get(f"{url}/v1/me").json() == {
        "project": {"id": "prj_default", "name": "default"},
        "scope": "admin",
        "key": None,
    }
    wrong = httpx.get(f"{url}/v1/me", headers={"authorization": "Bearer something"})
    assert wrong.status_code == 401, "credentials that come must be right"


def test_when_a_part_dies_the_rest_is_stopped_and_the_part_named(up):
    stack = up()
    url = stack.wait_until_up()
    pids = stack.wait_for_a_worker_child()
    redis = next(pid for pid in pids if b"redis-server" in Path(f"/proc/{pid}/cmdline").read_bytes())
    os.kill(redis, signal.SIGKILL)
    code, _, err = stack.end()
    assert code == 1
    assert "redis stopped by itself (killed by SIGKILL)" in err
    assert_nothing_left(stack.data, pids, url)


def test_a_taken_port_is_said_before_anything_starts(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "l3ps_cli.main", "up", "--data", tmp_path / "data", "--port", port]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert f"Port {port} on 127.0.0.1 is taken" in result.stderr
    assert not (tmp_path / "data" / "logs" / "redis.log").exists()
