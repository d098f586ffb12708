"""Every knob of the service in one object, read from the environment (prefix ``L3PS_``).

The same code serves the embedded stack, one machine and a cluster; only the URLs differ.
"""

from __future__ import annotations

from functools import lru_cache
from ipaddress import IPv4Network, IPv6Network, ip_network
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import parse_qs, unquote, urlsplit

from pydantic import BaseModel, ConfigDict, Field, SecretStr, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

MiB = 1024 * 1024
GiB = 1024 * MiB


class S3Location(BaseModel):
    """An S3 bucket as named by ``s3://KEY:SECRET@host:port/bucket?secure=0&region=…``."""

    model_config = ConfigDict(frozen=True, hide_input_in_errors=True)

    endpoint: str
    bucket: str
    access_key: str
    secret_key: SecretStr
    secure: bool = True
    region: str = "us-east-1"

    @classmethod
    def parse(cls, url: str) -> S3Location:
        """Read the URL; ValueError says what is missing."""
        parts = urlsplit(url)
        query = parse_qs(parts.query)
        bucket = parts.path.strip("/")
        if parts.scheme != "s3" or not parts.hostname or not bucket or "/" in bucket:
            raise ValueError("an S3 location is s3://KEY:SECRET@host:port/bucket?secure=0|1")
        if not parts.username or not parts.password:
            raise ValueError("the S3 location carries no credentials: s3://KEY:SECRET@host:port/bucket")
        return cls(
            endpoint=parts.hostname + (f":{parts.port}" if parts.port else ""),
            bucket=bucket,
            access_key=unquote(parts.username),
            secret_key=SecretStr(unquote(parts.password)),
            secure=query.get("secure", ["1"])[0] not in ("0", "false", "no"),
            region=query.get("region", ["us-east-1"])[0],
        )


class Settings(BaseSettings):
    """Settings of every process of the service.

    A field's comment gives the measurement or the rule behind its default.
    """

    # Values of settings hold secrets, so errors do not repeat them.
    model_config = SettingsConfigDict(env_prefix="L3PS_", extra="ignore", hide_input_in_errors=True)

    data_dir: Path = Field(default_factory=lambda: Path.home() / ".local" / "share" / "l3ps")
    # These three may hold a password: they are left out of the settings' repr, and their values out of errors.
    database_url: str = Field(default="", repr=False)  # empty: SQLite in data_dir
    redis_url: str = Field(default="redis://127.0.0.1:6379/0", repr=False)  # or unix:///path/redis.sock
    # file:///DIR or s3://KEY:SECRET@host:port/bucket?secure=0; empty: data_dir/objects
    objects_url: str = Field(default="", repr=False)
    # Where clients reach the S3 server, if not where the services reach it (inside compose: minio:9000, outside:
    # localhost:9000). A signature covers the host name, so it cannot be rewritten later. scheme://host:port
    objects_public_url: str | None = None
    # Where clients reach the API; the directory store's presigned URLs start with it.
    public_url: str = ""  # empty: http://host:port
    host: str = "127.0.0.1"
    port: int = 8080
    # The operator's. None: on loopback whoever reaches the service is the operator, elsewhere only API keys get in.
    token: SecretStr | None = None
    # Addresses and networks whose X-Forwarded-For is believed, comma-separated; empty: nobody's. Behind a proxy that is
    # not named here all clients share one address, and with it the limit of wrong credentials and the operator's rate.
    trusted_proxies: str = ""

    # What one API key (or, without keys, one address) may ask: 200 clients that each ask once a second under one key
    # must pass, with room for what else they do.
    rate_per_second: float = Field(default=1000.0, gt=0)
    rate_burst: int = Field(default=2000, ge=1)
    # Wrong credentials from one address. Secrets hold 256 bits, so this is about load, not about guessing.
    failures_per_second: float = Field(default=10.0, gt=0)
    failures_burst: int = Field(default=20, ge=1)
    # How long a process believes what it has read about a key. In the process that revokes one it ends at once.
    key_cache_seconds: float = Field(default=2.0, ge=0)
    max_open_uploads: int = Field(default=1000, ge=1)  # of a project
    max_open_upload_bytes: int = Field(default=1024 * GiB, ge=1)  # of a project: sixteen of the largest at once
    max_active_jobs: int = Field(default=1000, ge=1)  # of a project, trainings too

    idempotency_seconds: float = Field(default=24 * 3600.0, gt=0)  # life of an Idempotency-Key
    # How long a request with a key is waited for before it is taken for dead. Joining the parts of the largest upload
    # takes seconds; one that takes longer and still lives cannot commit once another has taken over.
    idempotency_lease_seconds: float = Field(default=60.0, gt=0)

    # Buckets that jobs may read from and never write to: a JSON list, or separated by commas, of
    # s3://KEY:SECRET@host:port/bucket/prefix?secure=0&project=prj_… (l3ps_platform.objects.sources).
    sources: SecretStr = SecretStr("")
    scratch_dir: Path | None = None  # unpacked drives and models of a worker; None: data_dir/scratch
    # Unpacked drives kept between stages. A scene's two stages and a drive's scenes read the same log; the largest
    # recordings met here unpack to well under 1 GB per 40 keyframes with six cameras.
    scratch_bytes: int = 20 * GiB

    # What an archive may grow to, against bombs; defaults and reasons are those of l3ps.drivelog.UnpackLimits.
    unpack_max_files: int = 1_000_000
    unpack_max_file_bytes: int = 8 * GiB
    unpack_max_total_bytes: int = 512 * GiB
    unpack_max_ratio: float = 100.0

    max_upload_bytes: int = 64 * GiB
    max_model_bytes: int = 512 * MiB
    max_annotations_bytes: int = 8 * GiB  # a training needs tens of images, whole data sets bring thousands
    part_bytes: int = 16 * MiB  # at least; larger where an upload would need more than S3's 10,000 parts
    upload_ttl_seconds: int = 24 * 3600  # an upload not completed by then is aborted and its parts deleted
    url_ttl_seconds: int = 3600
    migrate_on_start: bool | None = None  # None: when the catalog is SQLite; elsewhere a step of its own does it

    # A stage belongs to its worker for this long after the last sign of life. The signs come from a process of its own
    # beside the pool (l3ps_worker.pulse), so the lease need not outlast what compiled code does in one go: hdbscan held
    # the interpreter lock for more than 120 s on 1.8 M points.
    lease_seconds: float = 60.0
    heartbeat_seconds: float = 10.0
    max_attempts: int = 3
    retry_seconds: float = 5.0  # back-off: 5 s, 10 s, 20 s …
    # While the object store or the catalog is away, or the disk is full, a stage uses up no attempt. It is tried again
    # after as long as it has waited already, at most after this, and fails when it has waited this long in all.
    outage_retry_seconds: float = 60.0
    outage_seconds: float = 6 * 3600.0
    reconcile_seconds: float = 5.0
    # A queued stage without a claim for this long whose message is not in the queue is sent again.
    resend_seconds: float = 30.0
    # A process that has not stopped this long after its job was cancelled is deep in compiled code, and is killed.
    cancel_seconds: float = 10.0
    # How long what nothing refers to stays in the store: half-made objects of dead processes, checkpoints of trainings
    # that failed. Long enough to look into a failure, and to go on with a training.
    orphan_seconds: float = 24 * 3600.0
    orphans_every_seconds: float = 3600.0  # how often the whole store is looked through for them
    # Beyond this a stage is taken to hang: its process is killed and the attempt counts as failed.
    stage_seconds: float = 4 * 3600.0
    # The same for a training; the next attempt goes on from its last checkpoint. Below the day after which Redis
    # would deliver the message a second time.
    train_seconds: float = Field(default=20 * 3600.0, gt=0, lt=24 * 3600)
    progress_seconds: float = 0.5
    # When Redis delivers a message again that nobody has acknowledged. Redelivery is no part of our recovery (leases
    # are), so messages of long stages must not come back while they run: a task of 14 s under a visibility timeout of
    # 5 s was started three times. Claims make that harmless, but each costs a look at the catalog.
    visibility_seconds: int = Field(default=24 * 3600, gt=0)

    threads: int = 2  # of numeric libraries, per worker process
    # Workers yield the processor to an API on the same machine, whose answers take milliseconds.
    nice: int = Field(default=10, ge=0, le=19)
    concurrency: int = 1  # processes per worker: a stage uses `threads` threads and up to several GB

    # Memory that the refinement of one scene may take, per worker process; a larger scene is refined in overlapping
    # chunks. At 300 bytes a point (l3ps.refine.chunks) this holds 28 million points, 600 keyframes of nuScenes.
    refine_bytes: int = Field(default=8 * GiB, gt=0)

    # Whether a worker serves the queue `train`: it needs the trainer, which needs torch, so not every service has one.
    training: bool = False
    # Pretrained backbones by name, on the machine of that worker: NAME.onnx, a folder NAME of several graphs, or
    # weights NAME.pth. Clients name them and never a path.
    backbones_dir: Path | None = None  # None: data_dir/backbones
    checkpoint_seconds: float = 30.0  # how often a training's checkpoint and log go to the object store

    event_days: float = Field(default=30.0, gt=0)  # the event log and finished deliveries are kept for so long
    event_streams: int = Field(default=500, gt=0)  # open at once in an API process; 200 took 120 kB each
    # Networks that webhooks may reach though they are not public, e.g. 10.1.0.0/16,127.0.0.1/32; else a client could
    # have the service call into its own network.
    webhook_allow: Annotated[tuple[IPv4Network | IPv6Network, ...], NoDecode] = ()
    webhook_http: bool = False  # whether webhooks may go without TLS
    # The wait before each attempt; these are the specification's (standardwebhooks.com), over three days in all.
    webhook_retry_seconds: Annotated[tuple[float, ...], NoDecode] = (
        *(0.0, 5.0, 300.0, 1800.0),
        *(hours * 3600.0 for hours in (2, 5, 10, 14, 20, 24)),
    )
    webhook_timeout_seconds: float = Field(default=15.0, gt=0)  # for an attempt as a whole; the specification: 15 to 30
    webhook_disable_days: float = Field(default=5.0, gt=0)  # a webhook that took nothing for so long is switched off

    # What Prometheus has to send as a bearer token. The metrics name projects and models; None: anybody may read them.
    metrics_token: SecretStr | None = None
    metrics_jobs: int = 50  # quality series are kept for this many most recent jobs
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = "INFO"
    log_format: Literal["json", "console"] = "json"

    @field_validator("webhook_allow", "webhook_retry_seconds", mode="before")
    @classmethod
    def _listed(cls, value: object) -> object:
        return [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value

    @field_validator("metrics_token")
    @classmethod
    def _none_if_empty(cls, value: SecretStr | None) -> SecretStr | None:
        return (
            value if value is not None and value.get_secret_value() else None
        )  # compose hands on what is not set as ""

    @field_validator("trusted_proxies")
    @classmethod
    def _addresses(cls, value: str) -> str:
        for part in filter(None, (part.strip() for part in value.split(","))):
            try:
                ip_network(part)
            except ValueError:  # the server would take it for a name that never matches, or `*` for everybody
                raise ValueError("trusted proxies are addresses or networks, such as 10.0.0.7,172.18.0.0/16") from None
        return value

    @field_validator("database_url")
    @classmethod
    def _psycopg(cls, value: str) -> str:
        for scheme in ("postgresql://", "postgres://"):
            if value.startswith(scheme):
                return "postgresql+psycopg://" + value.removeprefix(scheme)
        if value and not value.startswith(("sqlite:///", "postgresql+psycopg://")):
            raise ValueError("the catalog is sqlite:///PATH or postgresql://USER:PASSWORD@HOST/DATABASE")
        return value

    @field_validator("objects_url")
    @classmethod
    def _known_store(cls, value: str) -> str:
        if value.startswith("s3://"):
            S3Location.parse(value)
        elif value and not value.startswith("file:///"):
            raise ValueError("the object store is file:///DIR or s3://KEY:SECRET@host:port/bucket")
        return value

    @property
    def loopback(self) -> bool:
        """Whether the API is reached from this machine alone."""
        return self.host in ("127.0.0.1", "localhost", "::1")

    @property
    def catalog_url(self) -> str:
        """The SQLAlchemy URL of the catalog."""
        return self.database_url or f"sqlite:///{self.data_dir / 'catalog.db'}"

    @property
    def migrates_on_start(self) -> bool:
        """Whether the API brings the catalog to the current schema itself."""
        return self.catalog_url.startswith("sqlite") if self.migrate_on_start is None else self.migrate_on_start

    @property
    def store_url(self) -> str:
        """The object store's URL."""
        return self.objects_url or (self.data_dir / "objects").absolute().as_uri()

    @property
    def api_url(self) -> str:
        """Where clients reach the API, without a trailing slash."""
        return (self.public_url or f"http://{self.host}:{self.port}").rstrip("/")

    @property
    def scratch(self) -> Path:
        """Where workers unpack."""
        return self.scratch_dir or self.data_dir / "scratch"

    @property
    def backbones(self) -> Path:
        """Where the backbones lie."""
        return self.backbones_dir or self.data_dir / "backbones"

    @property
    def broker_url(self) -> str:
        """The Redis URL in kombu's spelling (it calls a UNIX socket ``redis+socket``)."""
        if self.redis_url.startswith("unix://"):
            return "redis+socket://" + self.redis_url.removeprefix("unix://")
        return self.redis_url


@lru_cache(maxsize=1)
def get_settings() -> Settings:
    """The process' settings, read once."""
    return Settings()
