"""A line of the log says what it is about, whoever writes it."""

import json
import logging
import subprocess
import sys

import pytest

SCRIPT = """
import logging, sys, structlog
from l3ps_platform.settings import Settings
from l3ps_platform.telemetry import bound, configure_logging
configure_logging(Settings(log_format=sys.argv[1]), "worker")
with bound(job="job_1", scene=None, stage="stg_1"):
    structlog.get_logger("a").info("stage done", points=7)
    logging.getLogger("some.library").warning("careful: %s", "x")
try:
    1 / 0
except ZeroDivisionError:
    logging.getLogger("b").exception("broke")
logging.getLogger("urllib3").info("chatter")
"""


def run(form: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", SCRIPT, form], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    return done.stderr.splitlines()


def test_json_lines_carry_the_ids() -> None:
    ours, library, broke = map(json.loads, run("json"))
    assert (ours["event"], ours["points"], ours["service"], ours["level"]) == ("stage done", 7, "worker", "info")
    assert (ours["job"], ours["stage"]) == ("job_1", "stg_1")
    assert "scene" not in ours
    assert (library["event"], library["job"], library["logger"]) == ("careful: x", "job_1", "some.library")
    assert "ZeroDivisionError" in broke["exception"]
    assert "job" not in broke


def test_console_lines_are_for_people() -> None:
    lines = run("console")
    assert "stage done" in lines[0] and "job=job_1" in lines[0]
    with pytest.raises(ValueError):
        json.loads(lines[0])


def test_logging_is_untouched_until_asked() -> None:
    import l3ps_platform.telemetry

    assert l3ps_platform.telemetry
    assert not any(type(h).__module__.startswith("structlog") for h in logging.getLogger().handlers)
