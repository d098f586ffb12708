"""Jobs and trainings: what the service works on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

from l3ps_client._documents import Job, JobSummary, Page, Training, TrainingSummary
from l3ps_client._resource import Group, items, path
from l3ps_client._sse import Event
from l3ps_client._watching import follow, watch


class Jobs(Group):
    """``client.jobs``: one labelling of one drive with one model each."""

    def create(
        self,
        *,
        model: str,
        drive_id: str | None = None,
        source: str | None = None,
        preset: str | None = None,
        segment: str | None = None,
        formats: Sequence[str] | None = None,
        protocol: str | None = None,
        skip_bad_scans: bool = False,
        idempotency_key: str | None = None,
    ) -> Job:
        """Start a job; what is None is left to the service.

        Args:
            model: name or id of a model.
            drive_id: the drive to label, or
            source: where it lies in a bucket that the service may read: ``s3://bucket/prefix``.
            preset: ``paper``, ``best`` or ``fast``.
            segment: how images are looked at: ``fast``, ``balanced`` or ``paper``.
            formats: label formats to write: ``nuscenes``, ``semantickitti``.
            protocol: of the quality figures; default: the one that belongs to the log's truth.
            skip_bad_scans: label the good scans of a log that has bad ones.
            idempotency_key: the same key makes the same job, also from another process; default: a fresh one.
        """
        body: dict[str, Any] = {
            "drive_id": drive_id,
            "source": source,
            "model": model,
            "preset": preset,
            "segment": segment,
            "formats": [*formats] if formats else None,
            "protocol": protocol,
            "skip_bad_scans": skip_bad_scans or None,
        }
        body = {field: value for field, value in body.items() if value is not None}
        job: Job = self._wire.post(path("jobs"), body, key=idempotency_key)
        return job

    def get(self, job_id: str) -> Job:
        """A job in full: progress and cost of each scene's stages and, at its end, its quality."""
        job: Job = self._wire.get(path("jobs", job_id))
        return job

    def page(self, *, limit: int = 50, cursor: str | None = None, **filters: Any) -> Page[JobSummary]:
        """One page of jobs, newest first; filters as for ``list``."""
        page: Page[JobSummary] = self._wire.get(path("jobs"), limit=limit, cursor=cursor, **filters)
        return page

    def list(
        self,
        *,
        limit: int | None = None,
        state: str | None = None,
        drive_id: str | None = None,
        model_id: str | None = None,
        created_after: str | None = None,
        created_before: str | None = None,
    ) -> Iterator[JobSummary]:
        """Jobs, newest first, over all pages or the first ``limit``; times are ISO 8601."""
        return items(
            self._wire, path("jobs"), limit, state=state, drive_id=drive_id, model_id=model_id,
            created_after=created_after, created_before=created_before,
        )  # fmt: skip

    def cancel(self, job_id: str) -> Job:
        """Ask a job to stop, which it does within a scan."""
        job: Job = self._wire.post(path("jobs", job_id, "cancel"))
        return job

    def retry(self, job_id: str) -> Job:
        """Run again what is missing of a job that failed or was cancelled."""
        job: Job = self._wire.post(path("jobs", job_id, "retry"))
        return job

    def delete(self, job_id: str) -> None:
        """Delete a finished job's labels."""
        self._wire.delete(path("jobs", job_id))

    def events(self, job_id: str, *, after: str | None = None) -> Iterator[Event]:
        """What happens to a job, as it happens, until it is over; a broken connection is taken up where it was.

        First comes the job itself, as ``snapshot``, unless ``after`` gives the id of the last event that is known
        already; between the events ``progress`` tells how far the stages are.
        """
        return follow(self._wire, path("jobs", job_id, "events"), {}, after)

    def watch(self, job_id: str, *, timeout: float | None = None, poll: float | None = None) -> Iterator[Job]:
        """The job each time it has changed, the last one when it is over.

        Told by the service's event stream, which is taken up again where it breaks, or by asking every half second
        where there is none; with ``poll``, by asking every so many seconds. TimedOut after ``timeout`` seconds.
        """
        documents = watch(self._wire, path("jobs", job_id), path("jobs", job_id, "events"), timeout, poll)
        return cast(Iterator[Job], documents)

    def wait(
        self,
        job_id: str,
        *,
        timeout: float | None = None,
        progress: Callable[[Job], None] = lambda job: None,
        poll: float | None = None,
    ) -> Job:
        """The job once it is over, whatever its end; ``progress`` is called with it each time it has changed."""
        for job in self.watch(job_id, timeout=timeout, poll=poll):
            progress(job)
        return job


class Trainings(Group):
    """``client.trainings``: models made from annotated images."""

    def create(
        self,
        *,
        name: str,
        annotations: str,
        backbone: str,
        validation: str | float | None = None,
        idempotency_key: str | None = None,
        **settings: Any,
    ) -> Training:
        """Train a model.

        Args:
            name: what the model is to be called.
            annotations: id of annotations.
            backbone: one that the service has, or ``scratch``.
            validation: id of annotations to measure on, or a share of the images to set aside.
            idempotency_key: the same key makes the same training; default: a fresh one.
            settings: ``recipe``, ``format``, ``classes``, ``images``, ``size``, ``balanced``, ``epochs``, ``seed``,
                ``int8``, as ``/openapi.json`` describes them; None leaves one to the trainer.
        """
        body = {"name": name, "annotations": annotations, "backbone": backbone, "validation": validation} | settings
        body = {field: value for field, value in body.items() if value is not None}
        training: Training = self._wire.post(path("models", "train"), body, key=idempotency_key)
        return training

    def get(self, training_id: str) -> Training:
        """A training in full: progress, figures and the end of its log; once done its report and its model."""
        training: Training = self._wire.get(path("trainings", training_id))
        return training

    def page(self, *, limit: int = 50, cursor: str | None = None, **filters: Any) -> Page[TrainingSummary]:
        """One page of trainings, newest first; filters as for ``list``."""
        page: Page[TrainingSummary] = self._wire.get(path("trainings"), limit=limit, cursor=cursor, **filters)
        return page

    def list(self, *, limit: int | None = None, state: str | None = None) -> Iterator[TrainingSummary]:
        """Trainings, newest first, over all pages or the first ``limit``."""
        return items(self._wire, path("trainings"), limit, state=state)

    def cancel(self, training_id: str) -> Training:
        """Ask a training to stop, which it does within seconds."""
        training: Training = self._wire.post(path("trainings", training_id, "cancel"))
        return training

    def retry(self, training_id: str) -> Training:
        """Take up a training that failed or was cancelled, from its last checkpoint."""
        training: Training = self._wire.post(path("trainings", training_id, "retry"))
        return training

    def watch(self, training_id: str, *, timeout: float | None = None, poll: float | None = None) -> Iterator[Training]:
        """The training each time it has changed, the last one when it is over; asked for every half second."""
        return cast(Iterator[Training], watch(self._wire, path("trainings", training_id), None, timeout, poll))

    def wait(
        self,
        training_id: str,
        *,
        timeout: float | None = None,
        progress: Callable[[Training], None] = lambda training: None,
        poll: float | None = None,
    ) -> Training:
        """The training once it is over, whatever its end; ``progress`` is called with it each time it has changed."""
        for training in self.watch(training_id, timeout=timeout, poll=poll):
            progress(training)
        return training
