"""A Docker engine: the one that runs, or one of our own for as long as the check takes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from composecheck.command import INSTALL, CheckError, Docker
from composecheck.network import network_kept

START_SECONDS, STOP_SECONDS = 60, 60


@contextmanager
def engine(work: Path, data: Path | None) -> Iterator[Docker]:
    """A working engine: the one the environment names, else one started here and stopped at the end.

    Args:
        work: folder for logs and for what the engine writes.
        data: folder where an engine of our own keeps its images, to find them again next time; None: in ``work``.

    Raises:
        CheckError: there is none and none can be started.
    """
    docker = Docker(work / "commands.log", dict(os.environ))
    if shutil.which("docker") is None:
        raise CheckError(f"docker is not installed. On Debian: {INSTALL}")
    for plugin in ("compose", "buildx"):
        if not docker.works(plugin, "version"):
            raise CheckError(f"`docker {plugin}` is not installed. On Debian: {INSTALL}")
    if docker.works("info", seconds=20):
        yield docker
        return
    if shutil.which("dockerd") is None:
        raise CheckError(f"No Docker engine answers and none is installed. On Debian: {INSTALL}")
    if os.geteuid() != 0:
        raise CheckError("No Docker engine answers, and only root can start one: start it, or run this as root.")
    # The path of a UNIX socket has at most 107 bytes, and work may be anywhere.
    with network_kept(), tempfile.TemporaryDirectory(prefix="l3ps-engine-") as short:
        docker.own = True
        docker.env["DOCKER_HOST"] = f"unix://{short}/docker.sock"
        argv = ["dockerd", "--data-root", str((data or work / "engine").resolve()), "--exec-root", f"{short}/exec"]
        argv += ["--pidfile", f"{short}/dockerd.pid", "--host", docker.env["DOCKER_HOST"]]
        with (work / "dockerd.log").open("ab") as log:
            # A session of its own: Ctrl-C reaches this process alone, which takes the stack down before the engine.
            server = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        try:
            _wait_until_up(docker, server, work / "dockerd.log")
            yield docker
        finally:
            _stop(server)


def _wait_until_up(docker: Docker, server: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not docker.works("info", seconds=5):
        if server.poll() is not None or time.monotonic() > deadline:
            tail = "\n    ".join(log.read_text(errors="replace").splitlines()[-8:])
            raise CheckError(f"dockerd did not start within {START_SECONDS} s:\n    {tail}")
        time.sleep(0.2)


def _stop(server: subprocess.Popen[bytes]) -> None:
    """SIGTERM stops containers, containerd and engine; what is left of its process group after that is killed."""
    server.send_signal(signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        server.wait(STOP_SECONDS)
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGKILL)
    server.wait(10)
