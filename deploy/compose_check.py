"""Prove docker-compose.yml with a real engine: build, start, push a drive through, look at what came back, tear down.

    .venv/bin/python deploy/compose_check.py [--offline] [--keep] [--kill] [--drive LOG] [--model BUNDLE]
                                             [--engine-data DIR]

Starts an engine of its own where none runs, and leaves nothing behind: no container, volume, network, process or
file, but for the build cache of an engine that was there before. One line a step; exit status 0 (PASS) or 1 (FAIL).
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from composecheck import copies, kills, looks
from composecheck.command import ROOT, CheckError
from composecheck.engine import engine
from composecheck.images import provide
from composecheck.stack import Stack

SCANS, SEED = 6, 7
MODEL = ROOT / "services" / "cli" / "l3ps_cli" / "models" / "demo"


class Report:
    """One line a step, and the verdict."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self._began = time.monotonic()

    @contextmanager
    def step(self, name: str) -> Iterator[list[str]]:
        """Time a step; the list takes what there is to tell about it. A failure is printed and raised again."""
        facts: list[str] = []
        began = time.monotonic()
        try:
            yield facts
        except BaseException as error:
            self.failed.append(name)
            say(f"FAIL  {time.monotonic() - began:6.1f} s  {name}: {str(error) or type(error).__name__}")
            raise
        say(f"ok    {time.monotonic() - began:6.1f} s  {name}{': ' if facts else ''}{'; '.join(facts)}")

    def verdict(self) -> int:
        """Print PASS or FAIL; the exit status."""
        what = f"failed at: {', '.join(self.failed)}" if self.failed else "all steps passed"
        say(f"{'FAIL' if self.failed else 'PASS'}  compose-check in {time.monotonic() - self._began:.0f} s: {what}")
        return 1 if self.failed else 0


def check(report: Report, options: argparse.Namespace, work: Path) -> None:
    """All steps in order. The first failure ends them; what was started is taken down in any case."""
    with ExitStack() as undo:
        with report.step("engine") as facts:
            docker = undo.enter_context(engine(work, options.engine_data))
            facts.append(docker.run("version", "--format", "{{.Server.Version}}").strip())
            facts.append("started for this check" if docker.own else "was running")
        stack = Stack(docker, work)
        with report.step("no start without secrets") as facts:
            facts.append(looks.refuses_without_secrets(stack))
        with report.step("images of others") as facts:
            _, of_others = stack.images()
            stand_ins = provide(docker, of_others, options.offline)
            undo.callback(remove_images, stack, stand_ins)
            facts.append(f"stand-ins from Debian's packages for {', '.join(stand_ins)}" if stand_ins else "as pinned")
        with report.step("build") as facts:
            facts.extend(f"{image} {size:.0f} MB" for image, size in stack.build().items())
        undo.callback(take_down, report, stack)
        try:
            exercise(report, stack, options, work)
        except BaseException:
            with suppress(CheckError):
                say(stack.compose("ps", "--all"))
                say(stack.compose("logs", "--no-color", "--tail", "12"))
            raise
        if options.keep:
            say(f"Up at {stack.url} with L3PS_TOKEN={stack.settings['L3PS_TOKEN']} until Ctrl-C.")
            with suppress(KeyboardInterrupt):
                signal.pause()


def exercise(report: Report, stack: Stack, options: argparse.Namespace, work: Path) -> None:
    """Start the stack and use it."""
    with report.step("up"):
        stack.up()
    with report.step("hardening") as facts:
        facts.append(looks.hardening(stack))
    with report.step("imports") as facts:
        facts.append(looks.imports(stack))
    drive = options.drive or work / "drive"
    if not options.drive:
        with report.step("simulate a drive"):
            words = ("simulate", "--scenes", "1", "--scans", str(SCANS), "--seed", str(SEED), "--out")
            stack.cli(*words, drive, seconds=300)
    with report.step("push the drive through") as facts:
        job = looks.submit(stack, drive, options.model)
        facts.append(f"{job} succeeded")
    with report.step("labels") as facts:
        facts.append(looks.labels(stack, job, drive))
    with report.step("metrics") as facts:
        facts.append(looks.metrics(stack))
    if options.kill:
        for number, victim in enumerate(kills.VICTIMS, start=1):
            fresh = work / f"drive-{victim}"
            words = ("simulate", "--scenes", "2", "--scans", "3", "--seed", str(SEED + number), "--out")
            stack.cli(*words, fresh, seconds=300)
            with report.step(f"kill -9 of {victim} in the middle of a job") as facts:
                facts.append(kills.kill(stack, victim, fresh, options.model))
    other = work / "drive-copied"
    stack.cli("simulate", "--scenes", "2", "--scans", "3", "--seed", str(SEED - 1), "--out", other, seconds=300)
    with report.step("back-up in the middle of a job, all volumes lost, restore") as facts:
        facts.append(copies.lose_all_and_restore(stack, job, drive, other, options.model))
    with report.step("down, up again, labels still there") as facts:
        stack.down()
        stack.up()
        facts.append(looks.labels(stack, job, drive))


def take_down(report: Report, stack: Stack) -> None:
    """Remove containers, networks and volumes, and see that they are gone."""
    with report.step("down leaves nothing"):
        stack.down("--volumes", "--remove-orphans", "--timeout", "20")
        stack.assert_gone()


def remove_images(stack: Stack, stand_ins: list[str]) -> None:
    """Remove this check's images, and from an engine that others use the stand-ins, which must not pass for real."""
    built = [image for image in stack.docker.images() if image.endswith(f":{stack.project}")]
    for image in [*built, *([] if stack.docker.own else stand_ins)]:
        stack.docker.works("image", "rm", image)


def say(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)  # noqa: T201


def interrupt(*_: object) -> None:
    """Let SIGTERM take the same way out as Ctrl-C."""
    raise KeyboardInterrupt


def main() -> int:
    """Parse the command line and run the check."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--offline", action="store_true", help="do not try to pull images: make stand-ins at once")
    parser.add_argument("--keep", action="store_true", help="leave the stack up until Ctrl-C")
    parser.add_argument("--drive", type=Path, help="a nuScenes drive to push through instead of a simulated one")
    parser.add_argument("--model", default=str(MODEL), help="the model bundle to label it with")
    parser.add_argument("--kill", action="store_true", help="kill -9 every container in turn, each during a job (root)")
    parser.add_argument("--engine-data", type=Path, help="where an engine of our own keeps its images for next time")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, interrupt)
    report = Report()
    with tempfile.TemporaryDirectory(prefix="l3ps-compose-") as work:
        try:
            check(report, options, Path(work))
        except CheckError:
            pass  # its step has printed it
        except KeyboardInterrupt:
            report.failed.append("interrupted")
        except Exception:
            traceback.print_exc()
            report.failed.append("an error of the check itself")
    return report.verdict()


if __name__ == "__main__":
    sys.exit(main())
