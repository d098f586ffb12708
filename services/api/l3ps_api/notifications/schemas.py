"""S3 event notifications, as AWS and MinIO send them, and the answer to one."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

MAX_RECORDS = 1000


class Bucket(BaseModel):
    name: str = Field(max_length=255)


class Object(BaseModel):
    model_config = ConfigDict(populate_by_name=True)

    key: str = Field(max_length=4096, description="URL-encoded.")
    etag: str = Field(default="", max_length=200, alias="eTag")
    sequencer: str = Field(default="", max_length=200)


class Place(BaseModel):
    bucket: Bucket
    object: Object


class Record(BaseModel):
    """One event. Fields that are not named here are passed over."""

    model_config = ConfigDict(populate_by_name=True)

    event: str = Field(max_length=200, alias="eventName", examples=["ObjectCreated:Put", "s3:ObjectCreated:Put"])
    s3: Place


class Notification(BaseModel):
    """A batch of events; without records, such as the test event of AWS, nothing follows from it."""

    model_config = ConfigDict(populate_by_name=True)

    records: Annotated[list[Record], Field(max_length=MAX_RECORDS)] = Field(default_factory=list, alias="Records")


class Noted(BaseModel):
    """What followed from a notification."""

    accepted: int = Field(description="Objects that met a rule and become a job each.")
    known: int = Field(description="Objects that met a rule and were told of before.")
    ignored: int = Field(description="Events that met no rule, or tell of something else than a new object.")
