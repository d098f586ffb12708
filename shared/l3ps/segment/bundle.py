"""The model bundle: ``model.onnx`` and ``model.json`` in a directory or zip.

``model.json`` tells what the network wants and what its outputs mean; ``about.json`` of the same content is read where
there is no ``model.json``. Nothing here needs onnxruntime, so a service may check a bundle without carrying it.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from l3ps.errors import ModelError, Problem
from l3ps.taxonomy import NUSCENES16

MAX_JSON_BYTES = 1 << 20
MAX_MODEL_BYTES = 4 << 30
_DESCRIPTIONS = ("model.json", "about.json")


class InputSpec(BaseModel):
    """What the network is fed: one RGB image, resized, scaled to ``range``, then ``(x - mean) / std``."""

    model_config = ConfigDict(extra="ignore")

    name: str
    height: int = Field(gt=0, le=8192)
    width: int = Field(gt=0, le=8192)
    range: Literal["0..1", "0..255"] = "0..1"
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @model_validator(mode="after")
    def _usable(self) -> InputSpec:
        if min(self.std) <= 0:
            raise ValueError("std must be positive")
        return self


class OutputSpec(BaseModel):
    """Names of the network's outputs."""

    model_config = ConfigDict(extra="ignore")

    semantic: str
    """(1, C, h, w) logits."""
    boundary: str | None = None
    """(1, 1, h, w): probability that a pixel lies inside an object, not on the line between two."""
    boundary_threshold: float = Field(default=0.98, gt=0, lt=1)
    """Below it a pixel counts as boundary; 0.98 is the published value for averaged tilings."""


class ModelInfo(BaseModel):
    """Content of ``model.json``."""

    model_config = ConfigDict(extra="ignore")

    name: str = Field(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    label_space: Literal["nuscenes"] = "nuscenes"
    input: InputSpec
    output: OutputSpec
    classes: tuple[str, ...] = Field(min_length=1, max_length=1000)
    to_nuscenes: dict[str, int]

    @model_validator(mode="after")
    def _mapping_complete(self) -> ModelInfo:
        missing = [name for name in self.classes if name not in self.to_nuscenes]
        if missing:
            raise ValueError(f"to_nuscenes lacks the classes {', '.join(missing)}")
        wrong = sorted({c for c in self.to_nuscenes.values() if not 0 <= c < len(NUSCENES16.classes)})
        if wrong:
            raise ValueError(f"to_nuscenes maps to {wrong}, outside 0..{len(NUSCENES16.classes) - 1}")
        return self

    @property
    def lut(self) -> NDArray[np.uint8]:
        """(C,) uint8: network class index → ``NUSCENES16`` class."""
        return np.array([self.to_nuscenes[name] for name in self.classes], dtype=np.uint8)


@dataclass(frozen=True)
class ModelBundle:
    """A checked bundle in memory.

    Attributes:
        info: what ``model.json`` says.
        graph: the serialised ONNX graph.
        sha256: of graph and description; names the bundle in caches.
    """

    info: ModelInfo
    graph: bytes
    sha256: str

    @classmethod
    def load(cls, path: Path) -> ModelBundle:
        """Read a bundle from a directory or a zip.

        Raises:
            ModelError: naming the file and the remedy.
        """
        path = Path(path)
        try:
            if path.is_dir():
                members = {p.name: p for p in path.iterdir() if p.is_file()}
                description, graph = _pick(set(members), str(path))
                return cls._parse(members[description].read_bytes(), members[graph].read_bytes(), str(path))
            if not path.exists():
                raise _error("missing-model", str(path), "there is no such file or directory")
            with zipfile.ZipFile(path) as archive:
                return cls.from_zip(archive, str(path))
        except zipfile.BadZipFile as error:
            raise _error("not-a-model", str(path), f"it is neither a directory nor a readable zip ({error})") from error
        except OSError as error:
            raise _error("unreadable-model", str(path), f"it cannot be read ({error.strerror or error})") from error

    @classmethod
    def from_bytes(cls, data: bytes, where: str = "upload") -> ModelBundle:
        """Read a zipped bundle held in memory."""
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                return cls.from_zip(archive, where)
        except zipfile.BadZipFile as error:
            raise _error("not-a-model", where, f"it is not a readable zip ({error})") from error

    @classmethod
    def from_zip(cls, archive: zipfile.ZipFile, where: str) -> ModelBundle:
        """Read a bundle from an open zip; members may sit in one top folder."""
        members = {info.filename.rsplit("/", 1)[-1]: info for info in archive.infolist() if not info.is_dir()}
        description, graph = _pick(set(members), where)
        for name, limit in ((description, MAX_JSON_BYTES), (graph, MAX_MODEL_BYTES)):
            if members[name].file_size > limit:
                raise _error("model-too-large", f"{where}/{name}", f"it unpacks to {members[name].file_size} bytes")
        # The header's size is a claim: read one byte past the limit and no further.
        with archive.open(members[description]) as handle:
            text = handle.read(MAX_JSON_BYTES + 1)
        with archive.open(members[graph]) as handle:
            data = handle.read(members[graph].file_size + 1)
        return cls._parse(text, data, where)

    @classmethod
    def _parse(cls, text: bytes, graph: bytes, where: str) -> ModelBundle:
        try:
            info = ModelInfo.model_validate(json.loads(text))
        except ValidationError as error:
            raise ModelError(
                Problem("bad-model-json", f"{where}/model.json", f"{_path(e['loc'])}: {e['msg']}", "Correct the field.")
                for e in error.errors()
            ) from error
        except (ValueError, RecursionError) as error:
            raise _error("bad-model-json", f"{where}/model.json", f"it is not valid JSON ({error})") from error
        if not graph:
            raise _error("empty-model", f"{where}/model.onnx", "it is empty")
        digest = hashlib.sha256(graph)
        digest.update(info.model_dump_json().encode())
        return cls(info=info, graph=graph, sha256=digest.hexdigest())


def _pick(names: set[str], where: str) -> tuple[str, str]:
    description = next((name for name in _DESCRIPTIONS if name in names), None)
    if description is None or "model.onnx" not in names:
        lacking = "model.onnx" if description else "model.json"
        raise _error("incomplete-model", where, f"it holds no {lacking}")
    return description, "model.onnx"


def _path(location: tuple[int | str, ...]) -> str:
    return ".".join(map(str, location)) or "model.json"


def _error(code: str, where: str, what: str) -> ModelError:
    remedy = "A model bundle is a directory or zip that holds model.onnx and model.json."
    return ModelError(Problem(code, where, what, remedy))
