"""The nuScenes devkit pins numpy < 2, so it lives in an environment of its own, made once and kept in the cache."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
REQUIREMENTS = HERE / "requirements.txt"


def _uv() -> str:
    bundled = HERE.parent.parent / ".tools" / "bin" / "uv"
    found = os.environ.get("UV") or shutil.which("uv") or (str(bundled) if bundled.exists() else None)
    if found is None:
        message = "DEVKIT MISSING: the devkit's environment is made with uv; run `make setup` or put uv on PATH"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return found


def _make(python: Path) -> None:
    """Build the environment beside its place and rename it there, so that an interrupted build leaves nothing."""
    target = python.parent.parent
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="devkit-") as scratch:
        built = Path(scratch) / "env"
        uv = _uv()
        for command in (
            [uv, "venv", "--quiet", "--relocatable", "--python", sys.executable, str(built)],
            [
                uv,
                "pip",
                "install",
                "--quiet",
                "--python",
                str(built),
                "--no-deps",
                "--require-hashes",
                "-r",
                REQUIREMENTS,
            ],
        ):
            done = subprocess.run(command, check=False, capture_output=True, text=True)
            assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stderr}"
        try:
            built.rename(target)
        except OSError:
            assert python.exists()  # another run was faster


@pytest.fixture(scope="session")
def devkit() -> Callable[..., dict[str, Any]]:
    """Asks the official evaluator: ``devkit(what=..., **request)`` → its answer."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    key = hashlib.sha256(REQUIREMENTS.read_bytes() + version.encode()).hexdigest()[:12]
    python = cache / "l3ps" / f"devkit-env-{key}" / "bin" / "python"
    if not python.exists():
        _make(python)

    def ask(**request: Any) -> dict[str, Any]:
        done = subprocess.run(
            [python, HERE / "reference.py"], input=json.dumps(request), check=False, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        answer: dict[str, Any] = json.loads(done.stdout)
        return answer

    return ask
