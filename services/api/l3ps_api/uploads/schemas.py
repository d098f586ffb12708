"""Uploads as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from l3ps_platform.catalog import UploadState


def _of_no_folder(name: object) -> object:
    """Resources get their names from it, and whoever keeps files under those must not be led elsewhere."""
    if isinstance(name, str) and ("/" in name or "\\" in name):
        raise ValueError("a file's name has no / or \\ in it: leave its folders out")
    return name


Kind = Literal["drive", "model", "annotations"]
Name = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")
]
FileName = Annotated[Name, StringConstraints(pattern=r"^[^\x00-\x1f\x7f/\\]+$"), BeforeValidator(_of_no_folder)]
Sha256 = Annotated[str, StringConstraints(to_lower=True, pattern=r"^[0-9a-fA-F]{64}$")]


class UploadRequest(BaseModel):
    """The announcement of a file."""

    model_config = ConfigDict(extra="forbid")

    kind: Kind = Field(
        description="`drive`: an archive of a drive log; `model`: a zipped model bundle; `annotations`: an archive of "
        "annotated images to train from."
    )
    filename: FileName = Field(examples=["2026-11-22-morning.tar"])
    size: int = Field(ge=0, description="Bytes.")
    sha256: Sha256 | None = Field(default=None, description="Of the whole file; may also come at the completion.")


class PartUrl(BaseModel):
    number: int = Field(description="From 1.")
    url: str = Field(description="Where to PUT the part's bytes, without further credentials.")


class Upload(BaseModel):
    """An upload in progress, or what became of it."""

    id: str
    kind: str
    filename: str
    size: int
    state: UploadState
    result_id: str | None = Field(default=None, description="The drive, model or annotations it became.")
    created_at: datetime
    expires_at: datetime


class UploadPage(BaseModel):
    items: list[Upload]
    next: str | None = Field(default=None, description="Cursor of the next page, absent on the last.")


class ReceivedPart(BaseModel):
    number: int
    size: int = Field(description="Bytes.")
    etag: str = Field(description="The md5 of its bytes in hex.")


class UploadProgress(Upload):
    """An upload and what of it has arrived: all that is needed to go on with it."""

    part_size: int = Field(description="Bytes of every part but the last.")
    part_count: int = Field(description="How many parts there are.")
    received: list[ReceivedPart] = Field(description="The parts that have arrived whole, of an open upload.")
    joined: bool = Field(
        default=False,
        description="All parts have arrived and been joined, and no more can be sent: complete the upload, without "
        "naming parts.",
    )


class OpenUpload(Upload):
    """A fresh upload with the URLs of its parts."""

    part_size: int = Field(description="Bytes of every part but the last.")
    parts: list[PartUrl]


class PartsWanted(BaseModel):
    """The parts that URLs are wanted for."""

    model_config = ConfigDict(extra="forbid")

    numbers: list[Annotated[int, Field(ge=1, le=10_000)]] = Field(min_length=1, max_length=10_000)


class PartUrls(BaseModel):
    part_size: int = Field(description="Bytes of every part but the last.")
    parts: list[PartUrl]


class PartTag(BaseModel):
    model_config = ConfigDict(extra="forbid")

    number: int = Field(ge=1, le=10_000)
    etag: str = Field(min_length=1, max_length=200, description="The ETag that the PUT of the part answered.")


class Completion(BaseModel):
    """Says that all parts are there."""

    model_config = ConfigDict(extra="forbid")

    parts: list[PartTag] | None = Field(
        default=None,
        min_length=1,
        max_length=10_000,
        description="Every part with the ETag its PUT answered, to have both compared; default: those that arrived.",
    )
    name: Name | None = Field(default=None, description="What to call it; default: the file's name without its suffix.")
    sha256: Sha256 | None = Field(default=None, description="Of the whole file; checked before the log is used.")
