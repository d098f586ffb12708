"""No secret gets into a line of the log, an error or a repr, whichever way it is tried."""

import json
import subprocess
import sys

import pytest
from pydantic import ValidationError

from l3ps_platform.redaction import Redactor
from l3ps_platform.settings import S3Location, Settings

SECRETS = {
    "token": 'operator"s/token',
    "database": "p@ss/word-of-the-database",
    "redis": "password-of-redis",
    "s3": "s3-secret+with/signs",
}
ENVIRONMENT = {
    "L3PS_TOKEN": SECRETS["token"],
    "L3PS_DATABASE_URL": "postgresql://l3ps:p%40ss%2Fword-of-the-database@127.0.0.1:1/l3ps",
    "L3PS_REDIS_URL": "redis://:password-of-redis@127.0.0.1:1/0",
    "L3PS_OBJECTS_URL": "s3://key:s3-secret%2Bwith%2Fsigns@127.0.0.1:1/bucket?secure=0",
}
SCRIPT = """
import logging, threading, warnings, structlog
from l3ps_platform.catalog import Catalog
from l3ps_platform.objects import open_store
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings
from l3ps_platform.telemetry import configure_logging
settings = Settings()
configure_logging(settings, "api")
log = structlog.get_logger("a")
log.info("plainly", settings=repr(settings), token=settings.token.get_secret_value(), urls=[settings.objects_url])
for name, act in {
    "database": lambda: Catalog(settings.catalog_url).ping(),
    "redis": lambda: Queue(settings).ping(),
    "store": lambda: open_store(settings).ensure(),
    "words": lambda: [][settings.database_url],
}.items():
    try:
        act()
    except Exception:
        log.exception("broke", source=name)
warnings.warn(f"careful with {settings.redis_url}")
thread = threading.Thread(target=lambda: open(settings.database_url))
thread.start()
thread.join()
raise RuntimeError(f"the end of {settings.objects_url}")
"""


def forms(secret: str) -> set[str]:
    from urllib.parse import quote

    return {secret, quote(secret, safe=""), json.dumps(secret)[1:-1]}


def test_whatever_happens_to_a_process_its_lines_hold_no_secret() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False, env=ENVIRONMENT)
    assert done.returncode == 1 and done.stdout == ""
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    sources = {line["source"] for line in lines if line["event"] == "broke"}
    assert sources == {"database", "redis", "store", "words"}
    loggers = [line.get("logger") for line in lines]
    assert "py.warnings" in loggers and loggers.count("uncaught") == 2, "the thread's and the process'"
    for name, secret in SECRETS.items():
        assert not [form for form in forms(secret) if form in done.stderr], name


def test_settings_show_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    settings = Settings()
    shown = repr(settings) + str(settings) + repr(S3Location.parse(settings.objects_url))
    for name, secret in SECRETS.items():
        assert not [form for form in forms(secret) if form in shown], name
    monkeypatch.setenv("L3PS_DATABASE_URL", "mysql://l3ps:p%40ss%2Fword-of-the-database@host/l3ps")
    with pytest.raises(ValidationError) as refused:
        Settings()
    assert "postgresql" in str(refused.value) and "word-of-the-database" not in str(refused.value)


@pytest.mark.parametrize(
    ("said", "kept"),
    [
        ("l3ps_key_0123456789abcdefghijklmno_" + "x" * 43, "l3ps_key_0123456789abcdefghijklmno_…"),
        ("Authorization: Bearer abcdef123456", "Authorization: Bearer …"),
        ("GET /x?X-Amz-Signature=0123abcd&part=1", "GET /x?X-Amz-Signature=…&part=1"),
        ("amqp://user:hunter2@host/vhost", "amqp://user:…@host/vhost"),
        ("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "whsec_…"),
        ("l3ps_worker.runner says stage done at 12:30:00", "l3ps_worker.runner says stage done at 12:30:00"),
    ],
)
def test_what_looks_like_a_secret_goes_too_and_nothing_else(said: str, kept: str) -> None:
    assert Redactor(Settings())(said) == kept


def test_short_passwords_do_not_tear_holes_into_ordinary_words() -> None:
    redact = Redactor(Settings(token="job"))
    assert redact("the job is done") == "the job is done"
