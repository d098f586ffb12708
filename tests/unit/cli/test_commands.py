"""What the service commands say and how they end when something is wrong before any work is done."""

import json
import socket

import pytest
from typer.testing import CliRunner

from l3ps_cli.main import app


@pytest.fixture
def nobody(monkeypatch):
    """L3PS_URL names a port at which nobody answers."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # bound but not listening, so that nobody else listens either
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        monkeypatch.setenv("L3PS_URL", url)
        yield url


def run(*words) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, result.stderr


@pytest.mark.parametrize(
    "words", [["jobs"], ["jobs", "job_1"], ["download", "job_1", "--out", "x"], ["submit", "log.zip", "--model", "m"]]
)
def test_a_service_that_does_not_answer_is_exit_3_and_a_hint(nobody, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.zip").write_bytes(b"PK\x03\x04")
    code, said = run(*words)
    assert code == 3
    assert nobody in said and "l3ps up" in said


def test_a_log_that_is_not_there_is_exit_2(nobody, tmp_path):
    code, said = run("submit", tmp_path / "none", "--model", "m")
    assert (code, "there is no such file or directory" in said) == (2, True)


def test_a_log_that_is_no_archive_by_its_name_is_exit_2(nobody, tmp_path):
    (tmp_path / "log.rar").write_bytes(b"Rar!")
    code, said = run("submit", tmp_path / "log.rar", "--model", "m")
    assert (code, ".tar.zst" in said) == (2, True)


def test_a_bundle_without_its_network_is_exit_2(nobody, tmp_path):
    (tmp_path / "model.json").write_text("{}")
    code, said = run("submit", tmp_path, "--model", tmp_path)
    assert (code, "model.onnx" in said) == (2, True)


def test_a_running_stacks_note_can_be_read_by_scripts(tmp_path):
    from l3ps_cli.stack import running_stack

    assert running_stack(tmp_path) is None
    (tmp_path / "up.json").write_text("half a fi")
    assert running_stack(tmp_path) is None
    (tmp_path / "up.json").write_text(json.dumps({"url": "http://127.0.0.1:1", "token": None, "pid": 1}))
    assert running_stack(tmp_path)["url"] == "http://127.0.0.1:1"
