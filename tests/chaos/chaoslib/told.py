"""What was told of all that happened: each end once in the log, and each event once to the webhook."""

from collections import Counter

from chaoslib.stack import Service
from l3ps_platform.catalog import DriveRow, ModelRow, SceneRow, StageState, TrainingRow
from l3ps_platform.catalog.event_rows import DeliveryRow, EventRow, WebhookRow
from l3ps_platform.catalog.states import DeliveryState

_ENDS = ("succeeded", "failed", "cancelled")


def check(service: Service) -> None:
    """The log tells each end once and in order, and the witness heard of every event under one id."""
    events = service.rows(EventRow)
    by_subject: dict[str, list[str]] = {}
    for event in events:
        by_subject.setdefault(event.subject_id, []).append(event.kind)
    twice = 0
    for parent in [*service.all_jobs(), *service.rows(TrainingRow)]:
        kinds = [kind.partition(".")[2] for kind in by_subject[parent.id] if kind.split(".")[0] in ("job", "training")]
        # A life begins with `queued`, the first and each retry by hand, and has one end.
        lives = " ".join(kind for kind in kinds if kind in ("queued", *_ENDS)).split("queued")[1:]
        ends = [life.split() for life in lives]
        twice += sum(len(end) - 1 for end in ends if end)
        assert all(len(end) == 1 for end in ends), f"{parent.id}: not one end a life: {kinds}"
        assert ends[-1] == [parent.state.value], f"{parent.id} is {parent.state}, told was {kinds}"
    for upload in [*service.rows(DriveRow), *service.rows(ModelRow)]:
        told = [kind for kind in by_subject.get(upload.id, []) if kind.split(".")[0] in ("drive", "model")]
        thing = "drive" if isinstance(upload, DriveRow) else "model"
        trained = thing == "model" and any(training.model_id == upload.id for training in service.rows(TrainingRow))
        assert told == [f"{thing}.{upload.state}"] or (trained and not told), (upload.id, upload.state, told)
    _scenes(service, events)
    service.note("ends told twice", twice)
    _heard(service, events)


def _scenes(service: Service, events: list[EventRow]) -> None:
    told: dict[str, list[str]] = {}
    for event in events:
        if event.kind.startswith("scene."):
            told.setdefault(event.data["scene_id"], []).append(event.kind)
    for scene in service.rows(SceneRow):
        heard = told.get(scene.id, [])
        assert heard.count("scene.done") == (scene.state is StageState.DONE), (scene.id, scene.state, heard)
        if scene.state is StageState.FAILED:
            assert heard[-1] == "scene.failed", (scene.id, heard)


def _heard(service: Service, events: list[EventRow]) -> None:
    """One delivery an event, delivered; the same message may come twice, two messages for one event may not."""
    hook = next(row for row in service.rows(WebhookRow) if row.url == service.witness.url)
    deliveries = service.rows(DeliveryRow, DeliveryRow.webhook_id == hook.id)
    assert Counter(row.seq for row in deliveries) == Counter(event.seq for event in events), "not one delivery an event"
    lost = [(row.id, row.state, row.last_error) for row in deliveries if row.state is not DeliveryState.DELIVERED]
    assert not lost, f"not delivered: {lost}"
    held = [row.id for row in service.rows(DeliveryRow) if row.lease_owner is not None]
    assert not held, f"deliveries still held: {held}"
    assert service.witness.ids == {row.id for row in deliveries}, "the witness heard of something else"
    service.note("events told", len(events))
    service.note("messages repeated", len(service.witness.received) - len(deliveries))
