"""From an event to the arrivals it means."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from urllib.parse import unquote_plus

import structlog

from l3ps_api.notifications.schemas import Noted, Notification, Record
from l3ps_api.problems import too_large
from l3ps_api.services import Services
from l3ps_platform.catalog import RuleRow, rules
from l3ps_platform.objects import Reference, find_source
from l3ps_platform.workflow import settle_arrivals
from l3ps_platform.workflow.chores import Chore

log = structlog.get_logger(__name__)

ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.zst", ".tzst")
MAX_ARRIVALS = 2000
"""Recorded in one transaction, which on SQLite is the only one that writes: a tenth of a second's work."""
_SECONDS = 0.5
"""For which an answer waits for jobs to be made; what is left then the reconciler does."""


def take(services: Services, project_id: str, notification: Notification) -> Noted:
    """Record what met a rule, for good, and make jobs of it. 413 for more than can be recorded at once."""
    created = [record for record in notification.records if _is_creation(record.event)]
    with services.catalog.reading() as session:
        known_rules = rules.of_buckets(session, [record.s3.bucket.name for record in created])
    found: dict[tuple[str, str], tuple[RuleRow, str, str, str]] = {}
    met = 0
    for record in created:
        matches = list(_matches(services, project_id, known_rules, record))
        met += bool(matches)
        for match in matches:
            found.setdefault((match[0].id, match[1]), match)
        if len(found) > MAX_ARRIVALS:
            what = f"its objects meet more than {MAX_ARRIVALS} times one of the project's rules"
            raise too_large("Records", what, "Send fewer records at a time, or have fewer rules meet one object.")
    with services.catalog.transaction() as tx:
        new = rules.note(tx, list(found.values()))
    if new:
        chore = Chore("notification", "arrivals")  # counted by the reconciler, which takes up what fails here
        settle_arrivals(services.catalog, _SECONDS, services.settings.max_active_jobs, chore)
    ignored = len(notification.records) - met
    log.info("notification", accepted=len(new), known=len(found) - len(new), ignored=ignored)
    return Noted(accepted=len(new), known=len(found) - len(new), ignored=ignored)


def _is_creation(event: str) -> bool:
    return event.removeprefix("s3:").startswith("ObjectCreated:")


def _matches(
    services: Services, project_id: str, known: Sequence[RuleRow], record: Record
) -> Iterator[tuple[RuleRow, str, str, str]]:
    """(rule, digest, key, source) for each rule that a new object meets."""
    bucket, key = record.s3.bucket.name, unquote_plus(record.s3.object.key)
    for rule in known:
        log_path = log_of(rule, bucket, key)
        if log_path is None:
            continue
        try:
            reference = Reference.of(bucket, log_path)
        except ValueError as error:
            log.warning("arrival passed over", rule=rule.id, reason=str(error))
            continue
        if find_source(services.settings, reference, project_id) is not None:
            fields = (bucket, key, record.s3.object.etag, record.s3.object.sequencer)
            text = "".join(f"{len(field)}:{field}" for field in fields)
            yield rule, hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest(), key, str(reference)


def log_of(rule: RuleRow, bucket: str, key: str) -> str | None:
    """The path of the log that an object stands for under a rule; None where they do not meet."""
    below = not rule.prefix or key.startswith(f"{rule.prefix}/")
    if bucket != rule.bucket or not below or key.endswith("/"):
        return None
    if rule.suffix is None:
        return key if key.lower().endswith(ARCHIVES) else None
    if not key.endswith(rule.suffix):
        return None
    return key if rule.suffix.lower().endswith(ARCHIVES) else key.rpartition("/")[0]
