"""One training at work: what the trainer tells goes to the catalog, what must not be lost to the object store."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import structlog

from l3ps.errors import Cancelled, InputError, Problem
from l3ps.progress import Progress
from l3ps_platform import workflow
from l3ps_platform.catalog import Json, TrainingRow
from l3ps_platform.errors import CatalogUnavailable, LeaseLost, ObjectMissing, StoreError
from l3ps_worker.context import Context
from l3ps_worker.trainer import Event, Log, Trainer, TrainerLost, running

log = structlog.get_logger(__name__)

OUT = "out"
"""The trainer's result, in the working directory."""
CHECKPOINT = Path(OUT, ".training", "checkpoint.pt")
_BAD_INPUT = 2
_USELESS_CHECKPOINT = ("bad-checkpoint", "other-settings")
"""What the trainer says of a checkpoint that it does not go on from."""
_LOG_SECONDS = 5.0
_OPTIONS = ("recipe", "format", "images", "validation", "size", "balanced", "epochs", "seed")
"""Settings that are options of the trainer under the same name."""


class TrainingRun:
    """One attempt at a training.

    Args:
        context, claim, progress: as a stage gets them.
        row: the training.
        folder: the working directory.
        inputs: folders in it that hold annotations, as options of the trainer, and what the user calls each.
        checkpoint_key: where checkpoints are stored.

    Attributes:
        steps: (seconds, peak MB) of the trainer's steps so far.
    """

    def __init__(
        self,
        context: Context,
        claim: workflow.Claim,
        progress: Progress,
        row: TrainingRow,
        *,
        folder: Path,
        inputs: Mapping[str, str],
        checkpoint_key: str,
    ) -> None:
        self.steps: dict[str, tuple[float, float]] = {}
        self._context, self._claim, self._progress, self._row = context, claim, progress, row
        self._folder, self._inputs, self._checkpoint_key = folder, inputs, checkpoint_key
        self._log, self._log_key = Log(), f"trainings/{row.id}/log.txt"
        self._figures: Json = dict(row.figures or {})
        self._report: Json | None = None
        self._problems: list[Problem] = []
        self._at = ("features", 0, 1)
        self._began: dict[str, float] = {}
        self._restored = False
        self._saved: int | None = None  # the time stamp of the checkpoint that is in the store
        settings = context.settings
        self._duties = (
            _NowAndThen(self._tell, settings.progress_seconds),
            _NowAndThen(self._store_log, min(_LOG_SECONDS, settings.checkpoint_seconds)),
            _NowAndThen(self._save, settings.checkpoint_seconds),
        )

    def run(self, backbone: Sequence[str]) -> Json:
        """Run the trainer to its end, from the last checkpoint on where there is one.

        Args:
            backbone: its options that name the backbone.

        Returns:
            Its report.

        Raises:
            InputError: the annotations or settings cannot be used.
            TrainerLost: it ended in another way; the next attempt goes on from the checkpoint.
        """
        self._restore()
        try:
            with running(self._options(backbone), self._folder, self._log, gone=LeaseLost) as trainer:
                for event in trainer.events():
                    self._take(event, trainer)
        except LeaseLost:
            raise  # what lies in the store is another worker's now
        except Cancelled:
            self._store_log()
            self.forget()
            raise
        except BaseException:
            self._keep()
            raise
        self._keep()
        if trainer.child.returncode == _BAD_INPUT and self._problems:
            self.forget()
            if self._restored and self._problems[0].code in _USELESS_CHECKPOINT:
                raise TrainerLost("the checkpoint of the attempt before cannot be used; starting over")
            raise InputError(self._problems)
        if trainer.child.returncode != 0 or self._report is None:
            raise TrainerLost(self._ending(trainer))
        return self._report

    def forget(self) -> None:
        """Delete the checkpoint from the store."""
        with suppress(StoreError):
            self._context.store.delete(self._checkpoint_key)

    def _options(self, backbone: Sequence[str]) -> list[str]:
        """The trainer's command line. Values stand behind an equals sign, so that none is taken for an option."""
        asked = self._row.settings
        options = ["train", "annotations", f"--out={OUT}", "--events", f"--name={self._row.name}", *backbone]
        options.append(f"--threads={self._context.settings.threads}")
        options += [f"--{name}={_text(asked[name])}" for name in _OPTIONS if asked.get(name) is not None]
        options += ["--int8"] if asked.get("int8") else []
        options += ["--validation=validation"] if "validation" in self._inputs else []
        if asked.get("classes") is not None:
            (self._folder / "classes.json").write_text(json.dumps(asked["classes"]))
            options.append("--classes=classes.json")
        return options

    def _take(self, event: Event | None, trainer: Trainer) -> None:
        """Act on an event, or on there being none, and do what is due."""
        match event:
            case {"event": "progress", "step": str(step), "done": int(done), "total": int(total)}:
                began = self._began.setdefault(step, time.monotonic())
                self.steps[step] = (time.monotonic() - began, trainer.peak_mb())
                self._figures |= _figures(event)
                self._at = (step, done, total)
            case {"event": "done", "report": dict(report)}:
                self._report = report
            case {"event": "error", "problems": [*problems]}:
                self._problems = [self._as_known(Problem(**problem)) for problem in problems]
        self._progress(*self._at)
        for duty in self._duties:
            duty()

    def _tell(self) -> None:
        """Write the figures to the training's row, if there are new ones."""
        if self._figures == (self._row.figures or {}):
            return
        with suppress(CatalogUnavailable), self._context.catalog.transaction() as tx:
            workflow.note_training(tx, self._claim, figures=dict(self._figures))
            self._row.figures = dict(self._figures)

    def _store_log(self) -> None:
        if not self._log.changed:
            return
        try:
            self._context.store.put_bytes(self._log_key, self._log.bytes())
            self._log.changed = False
            if self._row.log_key is None:
                with self._context.catalog.transaction() as tx:
                    workflow.note_training(tx, self._claim, log_key=self._log_key)
                self._row.log_key = self._log_key
        except (StoreError, CatalogUnavailable) as error:
            log.warning("log not stored", reason=str(error))

    def _save(self) -> None:
        """Store the checkpoint, if there is a new one. A store that is away is borne: the training is worth more."""
        still = self._folder / "checkpoint"
        try:
            # The trainer may put a newer one in its place any moment; under a name of its own this one stays whole.
            still.unlink(missing_ok=True)
            os.link(self._folder / CHECKPOINT, still)
            stamp = still.stat().st_mtime_ns
            if stamp != self._saved:
                self._context.store.put_file(self._checkpoint_key, still)
                self._saved = stamp
        except FileNotFoundError:
            return
        except StoreError as error:
            log.warning("checkpoint not stored", reason=str(error))

    def _keep(self) -> None:
        """What the next attempt and the user need, at the end of this one."""
        self._save()
        self._store_log()
        self._tell()

    def _restore(self) -> None:
        """Fetch what an earlier attempt left: its checkpoint and its log."""
        checkpoint = self._folder / CHECKPOINT
        checkpoint.parent.mkdir(parents=True)
        with suppress(ObjectMissing):
            self._context.store.get_file(self._checkpoint_key, checkpoint)
            self._restored, self._saved = True, checkpoint.stat().st_mtime_ns
            log.info("training goes on from its checkpoint")
        if self._row.log_key is not None:
            with suppress(ObjectMissing):
                self._log.write(self._context.store.get_bytes(self._row.log_key))
            self._log.write(f"--- attempt {self._claim.attempt}\n".encode())

    def _ending(self, trainer: Trainer) -> str:
        if trainer.child.returncode == -signal.SIGKILL:
            return "the trainer was killed, most likely for using too much memory"
        said = self._log.last_line()
        return f"the trainer ended without a result ({trainer.child.ending}){f': {said}' if said else ''}"

    def _as_known(self, problem: Problem) -> Problem:
        """The same under the names that the user knows, instead of those of the working directory."""
        where, what = problem.where, problem.what
        for name, known in self._inputs.items():
            for path in (str((self._folder / name).resolve()), str(self._folder / name)):
                where, what = where.replace(path, known), what.replace(path, known)
            if where == name or where.startswith(f"{name}/"):
                where = known + where.removeprefix(name)
        where = where.removeprefix("--")  # options have the names of the request's fields
        return Problem(problem.code, where, what, problem.remedy, problem.severity, problem.scene, problem.scan)


class _NowAndThen:
    """An act that is done when it is due, however often it is called."""

    def __init__(self, act: Callable[[], None], seconds: float) -> None:
        self._act, self._seconds, self._due = act, seconds, float("-inf")

    def __call__(self) -> None:
        if time.monotonic() >= self._due:
            self._act()
            self._due = time.monotonic() + self._seconds


def _figures(event: Event | None) -> Json:
    """The figures that an event carries."""
    figures = (event or {}).get("figures")
    return figures if isinstance(figures, dict) else {}


def _text(value: object) -> str:
    """A setting as an option's value: (height, width) as ``HxW``."""
    return "x".join(map(str, value)) if isinstance(value, list) else str(value)
