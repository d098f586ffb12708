"""The application: what is mounted where, and what lives as long as the process."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

import structlog
from fastapi import Depends, FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from prometheus_client import CollectorRegistry, Gauge, ProcessCollector, generate_latest

from l3ps_api import errors
from l3ps_api.access_log import AccessLog
from l3ps_api.annotation_sets.routes import router as annotation_sets
from l3ps_api.auth import Gate, PrincipalDep, authenticate
from l3ps_api.description import describe
from l3ps_api.drives.routes import router as drives
from l3ps_api.etags import ETags
from l3ps_api.events.hub import EventHub
from l3ps_api.events.routes import router as events
from l3ps_api.idempotency import Idempotency
from l3ps_api.jobs.routes import router as jobs
from l3ps_api.keyring import Keyring
from l3ps_api.keys import service as key_service
from l3ps_api.keys.routes import router as keys
from l3ps_api.labels.routes import router as labels
from l3ps_api.middleware import JSON_BODY_BYTES, LoopbackHosts, RequestMetrics, SizeLimits
from l3ps_api.models.routes import router as models
from l3ps_api.notifications.routes import router as notifications
from l3ps_api.objects.routes import router as objects
from l3ps_api.operations import operations_of
from l3ps_api.places import Places, Turns
from l3ps_api.projects.routes import router as projects
from l3ps_api.replies import asked_within
from l3ps_api.retention.routes import router as retention
from l3ps_api.rules.routes import router as rules
from l3ps_api.services import Services
from l3ps_api.system.checks import check_all
from l3ps_api.system.routes import router as system
from l3ps_api.system.shared import Shared
from l3ps_api.trainings.routes import router as trainings
from l3ps_api.uploads import service as upload_service
from l3ps_api.uploads.routes import router as uploads
from l3ps_api.webhooks import service as webhook_service
from l3ps_api.webhooks.routes import router as webhooks
from l3ps_platform.catalog import Catalog
from l3ps_platform.catalog.migrate import upgrade
from l3ps_platform.chore_metrics import ChoreCollector
from l3ps_platform.errors import StoreUnavailable
from l3ps_platform.metrics import CatalogCollector, DiskCollector
from l3ps_platform.objects import open_store, parse_sources
from l3ps_platform.queue import Queue
from l3ps_platform.settings import Settings
from l3ps_platform.webhooks import Deliverer
from l3ps_platform.workflow import Reconciler, Sweeper

log = structlog.get_logger(__name__)

TURNS = 32
"""Requests worked on at once, of the forty threads that there are: a store that hangs holds those of one project for
half a minute, and 16 are not all."""
WAITING = 1000
"""Requests of a project that wait for a turn: the burst that a key may send is 2000."""
WAITING_BYTES = 16 << 20
"""Of their bodies: each is read before it waits, and as objects takes several times its bytes."""
ARCHIVES = 8
"""Archives sent at once: each holds a connection to the store and a manifest (45 MB for 68,000 files), and one of many
small files keeps a thread busy. On two busy cores, in one run each, a neighbour's request took 12 s with twice as many
and 0.3 s (median) with these."""

DESCRIPTION = """
Drive logs in, panoptic labels on every LiDAR point out.

1. `POST /v1/uploads` announces an archive; `PUT` its parts to the URLs answered; `POST …/complete` makes it a drive.
2. `POST /v1/jobs` labels a drive with a model; `GET /v1/jobs/{id}` shows progress, cost and quality.
3. `GET /v1/jobs/{id}/labels` lists the label files with presigned URLs; `…/labels.tar` is all of them in one.

A model comes as an upload of kind `model`, or from `POST /v1/models/train` with an upload of kind `annotations`;
`GET /v1/trainings/{id}` shows progress, log and report.

`GET /v1/jobs/{id}/events` follows a job as server-sent events, `GET /v1/events` all that happens; `POST /v1/webhooks`
has a URL told.

Every error is a problem document (RFC 9457) that names the field at fault and the remedy.
"""


def create_app(settings: Settings) -> FastAPI:
    """The API of one service."""
    parse_sources(settings.sources.get_secret_value())  # a service whose settings cannot be read does not start
    queue = Queue(settings)
    catalog = Catalog(settings.catalog_url, sender=queue.send)
    services = Services(settings, catalog, open_store(settings), queue)
    app = FastAPI(
        title="l3ps", version=version("l3ps-api"), description=DESCRIPTION.strip(), lifespan=_lifespan, redoc_url=None
    )
    app.state.services = services
    app.state.beside = Catalog(settings.catalog_url)
    app.state.keyring = Keyring(settings, catalog)
    app.state.events = EventHub(catalog, settings.event_streams)
    app.state.archives = Places(ARCHIVES, "too-many-archives", "archives", "Wait until one has been downloaded.")
    app.state.registry = CollectorRegistry()
    app.state.registry.register(CatalogCollector(catalog, queue, settings.metrics_jobs))
    app.state.registry.register(DiskCollector(settings))
    ProcessCollector(registry=app.state.registry)
    app.state.chores = (
        Reconciler(catalog, queue, settings), Sweeper(catalog, services.store, settings), Deliverer(catalog, settings)
    )  # fmt: skip
    app.state.registry.register(ChoreCollector([one.chore for one in app.state.chores]))
    streams = Gauge("l3ps_event_streams", "Open event streams.", registry=app.state.registry)
    streams.set_function(lambda: app.state.events.places.taken)
    app.state.metrics = Shared(lambda: generate_latest(app.state.registry))
    app.state.readiness = Shared(lambda: check_all(services))
    app.state.turns = Turns(TURNS, WAITING, WAITING_BYTES)
    guarded = [Depends(authenticate), Depends(_turn, scope="function")]
    app.include_router(system)
    app.include_router(objects)  # its URLs are signed, each for one act
    resources = (uploads, drives, jobs, labels, models, annotation_sets, trainings, retention, rules, notifications)
    for router in (*resources, events, webhooks, keys, projects):
        app.include_router(router, dependencies=guarded)
    errors.install(app)
    # The last added is the first to see a request.
    app.add_middleware(
        Idempotency, services=services, operations=lambda: operations_of(app),
        remade={
            "uploads": upload_service.opened, "api_keys": key_service.shown_again,
            "webhooks": webhook_service.shown_again,
        },
    )  # fmt: skip
    app.add_middleware(ETags, operations=lambda: operations_of(app))
    app.add_middleware(Gate, settings=settings, keyring=app.state.keyring, operations=lambda: operations_of(app))
    app.add_middleware(SizeLimits, exempt="/v1/objects/")
    app.add_middleware(errors.Problems)
    if settings.loopback and not settings.public_url:
        app.add_middleware(LoopbackHosts)
    if not settings.loopback and settings.token is None:
        log.warning("L3PS_TOKEN is not set: nobody is the operator, only API keys get in", host=settings.host)
    app.add_middleware(RequestMetrics, registry=app.state.registry)
    app.add_middleware(AccessLog)
    describe(app)
    return app


async def _turn(request: Request, principal: PrincipalDep) -> AsyncIterator[None]:
    if asked_within(request.scope):  # its turn is that of the one who asks
        yield
        return
    turns: Turns = request.app.state.turns
    declared = request.headers.get("content-length", "")
    chunked = "transfer-encoding" in request.headers
    size = int(declared) if declared.isdigit() else JSON_BODY_BYTES if chunked else 0
    async with turns.turn(principal.project_id, size):
        yield  # until there is an answer; sending it takes as long as the client does


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    services: Services = app.state.services
    if services.settings.migrates_on_start:
        await run_in_threadpool(upgrade, services.settings.catalog_url)
    try:
        await run_in_threadpool(services.store.ensure)
    except StoreUnavailable as error:
        log.warning("object store not reached at the start, /readyz tries again", reason=str(error))
    stop = threading.Event()
    threads = [
        threading.Thread(target=worker.run, args=(stop,), name=worker.chore.name, daemon=True)
        for worker in app.state.chores
    ]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        app.state.events.close()
        for thread in threads:
            await run_in_threadpool(thread.join, 10)
        services.catalog.dispose()
        app.state.beside.dispose()
        services.queue.close()
