"""The commands there are, and that those which only talk to a service start without the method's packages."""

import re
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

from l3ps_cli.main import COMMANDS, app


def test_help_lists_every_command_with_what_it_does():
    text = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).stdout
    lines = {words[1]: words[2:] for line in text.splitlines() if len(words := line.split()) > 3}
    for name in COMMANDS:
        assert name in lines, text


def test_an_unknown_command_is_a_usage_error():
    result = CliRunner().invoke(app, ["lable"])
    assert result.exit_code == 2 and "lable" in result.stderr


def test_service_commands_do_not_import_the_method():
    names = ("up", "submit", "jobs", "download", "drives", "models", "uploads", "keys", "webhooks", "whoami")
    code = (
        "import sys; from typer.testing import CliRunner; from l3ps_cli.main import app\n"
        f"for name in {names}: CliRunner().invoke(app, [name, '--help'])\n"
        "heavy = ('onnxruntime', 'scipy', 'cv2', 'hdbscan', 'kiss_icp', 'celery')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_packaged_model_tells_nothing_of_the_machine_it_was_made_on():
    import l3ps_cli

    graph = (Path(l3ps_cli.__file__).parent / "models" / "demo" / "model.onnx").read_bytes()
    assert len(graph) < 3_000_000
    assert not re.search(rb"site-packages|\.py\b|/home/|/root/", graph)
