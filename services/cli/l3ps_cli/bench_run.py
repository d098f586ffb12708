"""A measurement of ``l3ps bench`` in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from l3ps.errors import InputError, Problem, ProcessingError
from l3ps_cli.errors import err


def run_task(task: str, what: str, folder: Path, arguments: dict[str, Any]) -> dict[str, Any]:
    """Run a task of :mod:`l3ps_cli.bench_tasks` in a fresh process, whose memory nothing else has touched."""
    err.print(f"{what} …", highlight=False, soft_wrap=True)
    (folder / "arguments.json").write_text(json.dumps(arguments))
    done = subprocess.run(
        [sys.executable, "-m", "l3ps_cli.bench_tasks", task, str(folder)], stdout=subprocess.DEVNULL, check=False
    )
    answer = folder / f"{task}.json"
    if done.returncode != 0 or not answer.is_file():
        raise ProcessingError(f"the measurement '{task}' ended with code {done.returncode}; is there memory enough?")
    result: dict[str, Any] = json.loads(answer.read_text())
    if "problems" in result:
        raise InputError(Problem(**problem) for problem in result["problems"])
    if "error" in result:
        raise ProcessingError(result["error"])
    return result
