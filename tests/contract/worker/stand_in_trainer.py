"""Stands in for ``python -m l3ps_trainer``: the same command line, events and exit codes, and moods by its recipe.

The real one is in the tests of the API; this one dies, hangs and fails when told, which the real one does not.
It takes three steps, a checkpoint after each, and "learns" the bundle that lies beside it.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path


def tell(**event):
    print(json.dumps(event), flush=True)  # noqa: T201


def say(text):
    print(text, file=sys.stderr, flush=True)  # noqa: T201


def main(command, annotations, *words):
    assert command == "train" and "--events" in words, words
    options = dict(word.removeprefix("--").split("=", 1) for word in words if "=" in word)
    assert not any(name.startswith("L3PS_") for name in os.environ), "the service's settings and secrets"
    mood, out = options.get("recipe", "well"), Path(options["out"])
    checkpoint = out / ".training" / "checkpoint.pt"
    images = sorted(path.name for path in Path(annotations, "images").iterdir())
    say(f"{len(images)} images, options {sorted(options)}")
    if mood == "refuses":
        where = str(Path(annotations).resolve() / "images" / images[0])
        problem = {"code": "no-label", "where": where, "what": "it has no label", "remedy": "Add one."}
        other = problem | {"where": f"{annotations}/semantic", "code": "empty"}
        tell(event="error", problems=[problem, other, problem | {"where": "--size", "code": "bad-size"}])
        raise SystemExit(2)
    if mood == "crashes":
        raise SystemExit("Traceback: something broke")
    begun = int(checkpoint.read_text()) if checkpoint.is_file() else 0
    say(f"from step {begun}")

    def leave(*_):
        checkpoint.write_text("2")
        say("told to leave")
        raise SystemExit(143)

    signal.signal(signal.SIGTERM, signal.SIG_IGN if mood == "deaf" else leave)
    if mood == "deaf":
        child = subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"])
        say(f"forked {child.pid}")
    for step in range(begun + 1, 4):
        tell(event="progress", step="train", done=step, total=3, figures={"loss": 1 / step})
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        partial = checkpoint.with_suffix(".partial")
        partial.write_text(str(step))
        partial.replace(checkpoint)
        tell(event="progress", step="validate", done=1, total=1, figures={"miou": 10.0 * step})
        if mood == "dies" and step <= 2:
            os.kill(os.getpid(), signal.SIGKILL)
        if mood in ("stays", "deaf") and step == begun + 1:
            signal.pause()
    shutil.copytree(Path(__file__).parent / "bundle", out, dirs_exist_ok=True)
    description = json.loads((out / "model.json").read_text())
    (out / "model.json").write_text(json.dumps(description | {"name": options["name"]}))
    report = {"miou": 30.0, "images": images, "options": options}
    (out / "report.json").write_text(json.dumps(report))
    tell(event="done", report=report)


main(*sys.argv[1:])
