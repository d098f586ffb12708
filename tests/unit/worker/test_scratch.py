"""The worker's disk: made once, kept while used, bounded, and clean after the dead."""

import errno
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from l3ps_worker.scratch import Scratch


def writing(data: bytes):
    return lambda target: target.write_bytes(data)


def test_made_once_and_kept(tmp_path: Path) -> None:
    scratch, made = Scratch(tmp_path, 1000), []

    def make(target: Path) -> None:
        made.append(target)
        target.mkdir()
        (target / "file").write_bytes(b"x")

    for _ in range(2):
        with scratch.entry("drive-1", make) as path:
            assert (path / "file").read_bytes() == b"x"
    assert len(made) == 1


def test_many_who_want_it_at_once_share_one_making(tmp_path: Path) -> None:
    made, seen, barrier = [], [], threading.Barrier(8)

    def want() -> None:
        scratch = Scratch(tmp_path, 1000)
        barrier.wait()
        with scratch.entry("drive-1", lambda target: (made.append(1), target.write_bytes(b"x"))) as path:
            seen.append(path.read_bytes())

    threads = [threading.Thread(target=want) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(made), seen) == (1, [b"x"] * 8)


def test_a_failed_making_leaves_nothing(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path, 1000)

    def fail(target: Path) -> None:
        target.write_bytes(b"half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), scratch.entry("drive-1", fail):
        pass
    assert list((tmp_path / "cache").iterdir()) == []
    with scratch.entry("drive-1", writing(b"whole")) as path:
        assert path.read_bytes() == b"whole"


def test_half_an_entry_of_a_killed_process_is_made_anew(tmp_path: Path) -> None:
    (tmp_path / "cache" / "drive-1").mkdir(parents=True)
    (tmp_path / "cache" / "drive-1" / "new").write_bytes(b"half")
    with Scratch(tmp_path, 1000).entry("drive-1", writing(b"whole")) as path:
        assert path.read_bytes() == b"whole"


def test_the_longest_unused_go_first(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path, 250)
    for name in "abc":
        with scratch.entry(name, writing(b"x" * 100)):
            pass
        set_age(tmp_path, name, {"a": 30, "b": 20, "c": 10}[name])
    with scratch.entry("a", writing(b"")):  # used again: now b is the longest unused
        pass
    with scratch.entry("d", writing(b"x" * 100)):
        pass
    assert sorted(p.name for p in (tmp_path / "cache").iterdir()) == ["a", "c", "d"]


def set_age(root: Path, name: str, seconds: float) -> None:
    import os
    import time

    moment = time.time() - seconds
    os.utime(root / "cache" / name, (moment, moment))


def test_what_is_in_use_stays(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path, 0)
    with scratch.entry("a", writing(b"x" * 100)) as path:
        with Scratch(tmp_path, 0).entry("b", writing(b"x" * 100)):
            assert path.exists()
        scratch.drop("a")
        assert path.exists()
    scratch.drop("a")
    assert not path.exists()


@pytest.mark.parametrize("reason", [RuntimeError, FileNotFoundError])
def test_a_work_folder_is_gone_after_use(tmp_path: Path, reason: type[Exception]) -> None:
    scratch = Scratch(tmp_path, 0)
    with pytest.raises(reason, match="why it failed"), scratch.workdir() as folder:
        (folder / "x").write_bytes(b"x")
        raise reason("why it failed")
    assert list((tmp_path / "work").iterdir()) == []
    assert list((tmp_path / "locks").iterdir()) == []


def test_work_of_a_killed_process_is_swept_and_that_of_a_living_one_is_not(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path; from l3ps_worker.scratch import Scratch\n"
        "with Scratch(Path(sys.argv[1]), 0).workdir() as folder:\n"
        "    (folder / 'x').touch(); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", script, tmp_path], check=False)
    assert len(list((tmp_path / "work").iterdir())) == 1
    scratch = Scratch(tmp_path, 0)
    with scratch.workdir() as first, Scratch(tmp_path, 0).workdir() as second:
        assert sorted((tmp_path / "work").iterdir()) == sorted([first, second])


def test_a_full_disk_costs_the_entries_that_nobody_uses(tmp_path: Path) -> None:
    scratch, tries = Scratch(tmp_path, 1000), []
    for name in ("idle", "used"):
        with scratch.entry(name, writing(b"x")):
            pass

    def make(target: Path) -> None:
        tries.append((tmp_path / "cache" / "idle").exists())
        target.write_bytes(b"half")
        if len(tries) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        target.write_bytes(b"whole")

    with Scratch(tmp_path, 1000).entry("used", writing(b"")), scratch.entry("wanted", make) as path:
        assert path.read_bytes() == b"whole"
        assert (tmp_path / "cache" / "used" / "log").exists()
    assert tries == [True, False]


def test_a_disk_that_stays_full_leaves_nothing_half_made(tmp_path: Path) -> None:
    def fill(target: Path) -> None:
        target.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"), Scratch(tmp_path, 1000).entry("wanted", fill):
        pass
    assert list((tmp_path / "cache").iterdir()) == []


def test_half_an_entry_that_nobody_wants_again_goes_too(tmp_path: Path) -> None:
    (tmp_path / "cache" / "drive-1").mkdir(parents=True)
    (tmp_path / "cache" / "drive-1" / "new").write_bytes(b"half")
    with Scratch(tmp_path, 1000).entry("drive-2", writing(b"whole")):
        assert not (tmp_path / "cache" / "drive-1").exists()


def test_a_dead_worker_is_told_from_a_living_one(tmp_path: Path) -> None:
    """By a lock and not by a number: process ids and host names come again."""
    live = "import sys\nfrom pathlib import Path\nfrom l3ps_worker.scratch import Scratch\n"
    live += f"with Scratch(Path({str(tmp_path)!r}), 0).alive('host:7:a:'):\n    print('alive', flush=True), input()"
    scratch = Scratch(tmp_path, 0)
    with subprocess.Popen([sys.executable, "-c", live], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"alive\n"
        with scratch.alive("host:7:b:"):
            assert list(scratch.dead_workers()) == []
        other.kill()
        other.wait()
    dead = scratch.dead_workers()
    assert next(dead) in ("host:7:a:", "host:7:b:")
    dead.close()  # the caller failed: it is told of again
    assert sorted(scratch.dead_workers()) == ["host:7:a:", "host:7:b:"]
    assert list(scratch.dead_workers()) == []
