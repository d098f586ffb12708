"""The process manager with real children: what it starts, it also ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from l3ps_cli.processes import ChildDiedError, Processes

SLEEP = "import time; time.sleep(600)"


def gone(pid: int, seconds: float = 10.0) -> bool:
    """Whether a process ends within the time (a zombie has ended)."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.02)
    return False


def first_line(path: Path, seconds: float = 10.0) -> str:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if path.exists() and "\n" in (text := path.read_text()):
            return text.splitlines()[0]
        time.sleep(0.02)
    raise AssertionError(f"{path} stayed empty")


@pytest.fixture
def processes(tmp_path):
    with Processes(tmp_path / "logs") as manager:
        yield manager


def start_python(manager: Processes, name: str, code: str, **options):
    return manager.start(name, [sys.executable, "-u", "-c", code], dict(os.environ), **options)


def test_children_are_stopped_last_started_first(processes, tmp_path):
    order = tmp_path / "order"
    code = (
        "import signal, sys, time\n"
        "def leave(*_):\n"
        "    open(sys.argv[1], 'a').write(sys.argv[2])\n"
        "    sys.exit()\n"
        "signal.signal(signal.SIGTERM, leave)\n"
        "print('ready'); time.sleep(600)"
    )
    for name in "abc":
        processes.start(name, [sys.executable, "-u", "-c", code, order, name], dict(os.environ))
    for name in "abc":
        first_line(tmp_path / f"logs/{name}.log")
    processes.stop()
    assert order.read_text() == "cba"
    assert all(child.returncode == 0 for child in processes.children)


def test_a_child_that_ignores_the_request_is_killed(processes, tmp_path):
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('ready'); time.sleep(600)"
    child = start_python(processes, "deaf", deaf, stop_plan=((signal.SIGTERM, 0.2),))
    first_line(processes.log_of(child.name))
    processes.stop()
    assert child.returncode == -signal.SIGKILL


def test_what_a_child_forked_goes_with_it(processes):
    forks = f"import subprocess, sys; print(subprocess.Popen([sys.executable, '-c', {SLEEP!r}]).pid)"
    child = start_python(processes, "forks", forks)
    grandchild = int(first_line(processes.log_of(child.name)))
    processes.stop()
    assert gone(grandchild)


def test_a_child_that_dies_is_reported_with_its_ending_and_log(processes):
    start_python(processes, "short", "print('could not bind'); raise SystemExit(7)")
    with pytest.raises(ChildDiedError, match=r"short stopped by itself \(exit status 7\).*short\.log") as caught:
        processes.wait_until(lambda: False, "nothing", 10)
    assert caught.value.last_lines == "could not bind"


def test_what_is_never_ready_ends_in_a_sentence(processes):
    start_python(processes, "idle", SLEEP)
    with pytest.raises(TimeoutError, match="the API was not ready within"):
        processes.wait_until(lambda: False, "the API", 0.1)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's help exists on Linux only")
def test_a_killed_parent_leaves_no_child(tmp_path):
    code = (
        "import os, sys, time; from pathlib import Path; from l3ps_cli.processes import Processes\n"
        "with Processes(Path(sys.argv[1])) as manager:\n"
        f"    print(manager.start('child', [sys.executable, '-c', {SLEEP!r}], dict(os.environ)).pid, flush=True)\n"
        "    time.sleep(600)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, tmp_path], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    assert gone(child)
