"""The real service, twice, with an eye on what its workers use and on what is left behind."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest
from tests.contract.api import conftest as api
from tests.contract.api.conftest import Service

from .case import FULL
from .cases_models import small_bundle
from .samples import Samples, read_folder

LIMITS = {} if FULL else {"L3PS_UNPACK_MAX_FILES": "2000"}
LIMITS |= {"L3PS_RETRY_SECONDS": "0.1"}


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    """A small log and a small model."""
    from l3ps.simulate import simulate_drive

    folder = tmp_path_factory.mktemp("log") / "street"
    simulate_drive(folder, scenes=1, scans=3, seed=5, width=320)
    return Samples(read_folder(folder), small_bundle())


@pytest.fixture(scope="session", params=["embedded", "servers"] if FULL else ["servers"])
def service(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service as ``l3ps up`` runs it, and on PostgreSQL, MinIO and a Redis server; not the one of other tests.

    Each takes ten seconds to start, so that only ``make hostile`` takes both.
    """
    data = tmp_path_factory.mktemp("hostile")
    embedded, servers = partial(api._embedded, training=False), partial(api._servers, redis_database=2)
    start = embedded if request.param == "embedded" else servers
    with pytest.MonkeyPatch.context() as patch:
        for name, value in LIMITS.items():
            patch.setenv(name, value)
        with start(request, data) as settings, api._looked_into(settings) as running:
            yield running


@dataclass
class Watch:
    """What the workers' processes used while somebody looked.

    Attributes:
        peaks: process id → the most resident memory the kernel saw, MB.
    """

    data: Path
    peaks: dict[int, float] = field(default_factory=dict)

    def processes(self) -> dict[int, str]:
        """The service's worker processes and what they started, by id, with their command lines."""
        found = {}
        marker = f"L3PS_DATA_DIR={self.data}".encode()
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                with suppress(OSError):
                    words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                    if "l3ps" in words and marker in (folder / "environ").read_bytes().split(b"\0"):
                        found[int(folder.name)] = words
        return found

    def look(self) -> None:
        for pid, words in self.processes().items():
            if "l3ps_api" not in words:
                with suppress(OSError, StopIteration):
                    lines = Path("/proc", str(pid), "status").read_text().splitlines()
                    kilobytes = next(line.split()[1] for line in lines if line.startswith("VmHWM"))
                    self.peaks[pid] = max(self.peaks.get(pid, 0.0), int(kilobytes) / 1000)


@contextmanager
def watched(data: Path) -> Iterator[Watch]:
    """Look twenty times a second; the kernel keeps the peak, so nothing between is missed."""
    watch, stop = Watch(data), threading.Event()

    def run() -> None:
        while not stop.wait(0.05):
            watch.look()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield watch
    finally:
        stop.set()
        thread.join()
        watch.look()
