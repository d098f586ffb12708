"""The client: one connection to one service, its resources as attributes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpx

from l3ps_client._access import Keys, Projects, RetentionRules
from l3ps_client._config import Config, cache_folder
from l3ps_client._files import AnnotationSets, Drives, Models, Uploads
from l3ps_client._hooks import Events, Rules, Webhooks
from l3ps_client._jobs import Jobs, Trainings
from l3ps_client._labels import Labels
from l3ps_client._ledger import Ledger
from l3ps_client._project_documents import Me
from l3ps_client._wire import Retry, Wire, new_key

DEFAULT_STATE = Path()
"""Stands for the user's cache folder, which is looked up when a client is made."""


class Client:
    """A connection to one running service; may be shared between threads.

    Args:
        url: base address; default ``L3PS_URL``, else that of an ``l3ps up`` on this machine.
        token: bearer token; default ``L3PS_TOKEN``, else that of the same ``l3ps up``.
        project: id of the project the operator acts in; default ``L3PS_PROJECT``. A key has its own.
        timeout: seconds without a byte before an answer is given up.
        retry: how patient to be.
        state: folder for notes of unfinished uploads; default the user's cache folder, None keeps none, and an
            interrupted upload is then given up.
    """

    def __init__(
        self,
        url: str | None = None,
        token: str | None = None,
        *,
        project: str | None = None,
        timeout: float = 60.0,
        retry: Retry | None = None,
        state: Path | None = DEFAULT_STATE,
    ) -> None:
        config = Config.of(url, token, project)
        self.url = config.url
        self._wire = Wire(config, timeout, retry or Retry())
        self.uploads = Uploads(self._wire, Ledger(cache_folder() if state is DEFAULT_STATE else state))
        self.drives = Drives(self._wire, self.uploads)
        self.annotations = AnnotationSets(self._wire, self.uploads)
        self.models = Models(self._wire, self.uploads)
        self.jobs = Jobs(self._wire)
        self.labels = Labels(self._wire)
        self.trainings = Trainings(self._wire)
        self.events = Events(self._wire)
        self.webhooks = Webhooks(self._wire)
        self.rules = Rules(self._wire)
        self.projects = Projects(self._wire)
        self.keys = Keys(self._wire)
        self.retention = RetentionRules(self._wire)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of all connections."""
        self._wire.close()

    def me(self) -> Me:
        """Who the service takes the caller for: project, scope and key."""
        me: Me = self._wire.get("/v1/me")
        return me

    def request(
        self, method: str, path: str, *, params: Mapping[str, Any] | None = None, json: Any = None,
        headers: Mapping[str, str] | None = None,
    ) -> httpx.Response:  # fmt: skip
        """Any other request to the service, such as ``GET /openapi.json``: repeated and refused as all are."""
        given = dict(headers or {})
        if method == "POST":
            given.setdefault("Idempotency-Key", new_key())
        return self._wire.request(method, path, params=params, json=json, headers=given)
