"""The real API in a real process, with everything it stands on, and eyes into its catalog and store."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from l3ps_cli.stack import Stack, StackOptions
from l3ps_platform.catalog import Catalog
from l3ps_platform.objects import ObjectStore, open_store
from l3ps_platform.settings import Settings

MiB = 1 << 20


@dataclass
class Service:
    """A running service as a client sees it, with its catalog and object store for looking behind the curtain."""

    http: httpx.Client
    catalog: Catalog
    store: ObjectStore
    settings: Settings

    def announce(self, size: int, filename: str = "log.tar", kind: str = "drive") -> dict:
        answer = self.http.post("/v1/uploads", json={"kind": kind, "filename": filename, "size": size})
        assert answer.status_code == 201, answer.text
        return answer.json()

    def put_parts(self, upload: dict, data: bytes) -> list[dict]:
        size = upload["part_size"]
        tags = []
        for part in upload["parts"]:
            start = (part["number"] - 1) * size
            answer = httpx.put(part["url"], content=data[start : start + size])
            assert answer.status_code == 200, answer.text
            tags.append({"number": part["number"], "etag": answer.headers["etag"]})
        return tags

    def upload(self, data: bytes, filename: str = "log.tar", kind: str = "drive", **completion) -> httpx.Response:
        """The whole upload; the answer to its completion."""
        upload = self.announce(len(data), filename, kind)
        parts = self.put_parts(upload, data)
        return self.http.post(f"/v1/uploads/{upload['id']}/complete", json={"parts": parts, **completion})

    def objects(self) -> set[str]:
        return {info.key for info in self.store.list()}


@pytest.fixture(scope="session")
def service(tmp_path_factory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("service")
    os.environ["L3PS_PART_BYTES"] = str(5 * MiB)
    with Stack(StackOptions(data, port=0, workers=1)) as stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        settings = Settings(data_dir=data, port=int(stack.url.rpartition(":")[2]))
        catalog = Catalog(settings.catalog_url)
        yield Service(http, catalog, open_store(settings), settings)
        catalog.dispose()
