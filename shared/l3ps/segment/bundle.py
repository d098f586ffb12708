"""The model bundle: ``model.onnx`` and ``model.json`` in a directory or zip.

``model.json`` tells what the network wants and what its outputs mean; ``about.json`` of the same content is read where
there is no ``model.json``. Further graphs (``passes``) and files with weights lie beside them. Everything is held in
memory, so that nothing later opens a file that a graph names. Nothing here needs onnxruntime, so a service may look at
a bundle without carrying it.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from l3ps.drivelog.archive_names import shown
from l3ps.errors import ModelError, Problem
from l3ps.segment.external import PLAIN_NAME, external_tensors
from l3ps.segment.files import MAX_MODEL_BYTES, BundleFiles, FolderFiles, ZipFiles, bundle_error
from l3ps.taxonomy import NUSCENES16

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"
"""Of a model's name."""
MAX_JSON_BYTES = 1 << 20
MAX_GRAPH_BYTES = (2 << 30) - 1
"""What a protobuf message can be; larger weights lie in files beside the graph."""
_DESCRIPTIONS = ("model.json", "about.json")
_MAX_PROBLEMS = 20
_MAX_CHARACTERS = 100


def _printable(name: str) -> str:
    # Names go into messages, logs and a database that keeps neither NUL nor half of a UTF-16 pair.
    if not name or len(name) > _MAX_CHARACTERS or not name.isprintable():
        raise ValueError(f"a name is 1 to {_MAX_CHARACTERS} printable characters")
    return name


_Name = Annotated[str, AfterValidator(_printable)]


class InputSpec(BaseModel):
    """What the network is fed: one RGB image, resized, scaled to ``range``, then ``(x - mean) / std``."""

    model_config = ConfigDict(extra="ignore")

    name: _Name
    height: int = Field(gt=0, le=8192)
    width: int = Field(gt=0, le=8192)
    range: Literal["0..1", "0..255"] = "0..1"
    mean: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, 0.0)
    std: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (1.0, 1.0, 1.0)

    @model_validator(mode="after")
    def _usable(self) -> InputSpec:
        if min(self.std) <= 0:
            raise ValueError("std must be positive")
        return self


class OutputSpec(BaseModel):
    """Names of the network's outputs."""

    model_config = ConfigDict(extra="ignore")

    semantic: _Name
    """(1, C, h, w) logits."""
    boundary: _Name | None = None
    """(1, 1, h, w): probability that a pixel lies inside an object, not on the line between two."""
    boundary_threshold: float = Field(default=0.98, gt=0, lt=1)
    """Below it a pixel counts as boundary; 0.98 is the published value for averaged tilings."""


class PassSpec(BaseModel):
    """A further graph of the same network, with the same names, for another input size."""

    model_config = ConfigDict(extra="ignore")

    graph: str = Field(pattern=PLAIN_NAME)
    height: int = Field(gt=0, le=8192)
    width: int = Field(gt=0, le=8192)


class ModelInfo(BaseModel):
    """Content of ``model.json``."""

    model_config = ConfigDict(extra="ignore")

    name: str = Field(min_length=1, max_length=100, pattern=NAME_PATTERN)
    label_space: Literal["nuscenes"] = "nuscenes"
    input: InputSpec
    output: OutputSpec
    classes: tuple[_Name, ...] = Field(min_length=1, max_length=1000)
    to_nuscenes: dict[_Name, int]
    passes: dict[Annotated[str, Field(pattern=PLAIN_NAME)], PassSpec] = Field(default_factory=dict, max_length=8)
    """Segmentation preset → the graph that it runs, where that is not ``model.onnx``."""

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
        sha256: of all graphs, their data and the description; names the bundle in caches.
        graphs: file name → further serialised graphs, those of ``info.passes``.
        data: file name → content of the files that the graphs take weights from. A session is given these bytes and
            opens nothing by itself.
    """

    info: ModelInfo
    graph: bytes
    sha256: str
    graphs: Mapping[str, bytes] = field(default_factory=dict)
    data: Mapping[str, bytes] = field(default_factory=dict)

    def graph_for(self, preset: str) -> tuple[bytes, InputSpec]:
        """The graph that a segmentation preset runs, and what it is fed.

        ``fast`` and ``paper`` run ``model.onnx`` unless the bundle has a graph of their own.

        Raises:
            ModelError: when the bundle has no graph for the preset.
        """
        if preset in self.info.passes:
            chosen = self.info.passes[preset]
            size = {"height": chosen.height, "width": chosen.width}
            return self.graphs[chosen.graph], self.info.input.model_copy(update=size)
        if preset in {"fast", "paper"}:
            return self.graph, self.info.input
        what = f"it has no graph for the preset '{preset}' (it has {', '.join(['fast', 'paper', *self.info.passes])})"
        remedy = "Export it with `l3ps train … --balanced HxW`, or choose the preset fast."
        raise ModelError(Problem("missing-pass", f"model '{self.info.name}'", what, remedy))

    @classmethod
    def load(cls, path: Path) -> ModelBundle:
        """Read a bundle from a directory or a zip.

        Raises:
            ModelError: naming the file and the remedy.
        """
        path = Path(path)
        try:
            if path.is_dir():
                return cls._read(FolderFiles(path))
            if not path.exists():
                raise bundle_error("missing-model", str(path), "there is no such file or directory")
            with zipfile.ZipFile(path) as archive:
                return cls.from_zip(archive, str(path))
        except zipfile.BadZipFile as error:
            raise bundle_error(
                "not-a-model", str(path), f"it is neither a directory nor a readable zip ({error})"
            ) from error
        except OSError as error:
            raise bundle_error(
                "unreadable-model", str(path), f"it cannot be read ({error.strerror or error})"
            ) from error

    @classmethod
    def from_bytes(cls, data: bytes, where: str = "upload") -> ModelBundle:
        """Read a zipped bundle held in memory."""
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                return cls.from_zip(archive, where)
        except zipfile.BadZipFile as error:
            raise bundle_error("not-a-model", where, f"it is not a readable zip ({error})") from error

    @classmethod
    def from_zip(cls, archive: zipfile.ZipFile, where: str) -> ModelBundle:
        """Read a bundle from an open zip; members may sit in one top folder."""
        return cls._read(ZipFiles(archive, where))

    @classmethod
    def _read(cls, files: BundleFiles) -> ModelBundle:
        where = files.where
        description = next((name for name in _DESCRIPTIONS if name in files.names), None)
        if description is None or "model.onnx" not in files.names:
            raise bundle_error(
                "incomplete-model", where, f"it holds no {'model.onnx' if description else 'model.json'}"
            )
        text = files.read(description, MAX_JSON_BYTES)
        graph = files.read("model.onnx", MAX_GRAPH_BYTES)
        info = _parse(text, where)
        further = sorted({chosen.graph for chosen in info.passes.values()} - {"model.onnx"})
        graphs = {name: files.read(name, MAX_GRAPH_BYTES, linked=False) for name in further}
        data: dict[str, bytes] = {}
        for name, content in {"model.onnx": graph, **graphs}.items():
            if not content:
                raise bundle_error("empty-model", f"{where}/{name}", "it is empty")
            _add_data(data, files, name, content)
        digest = hashlib.sha256(graph)
        digest.update(info.model_dump_json(exclude=None if info.passes else {"passes"}).encode())
        for name, content in {**graphs, **data}.items():
            digest.update(f"\0{name}\0{len(content)}\0".encode())
            digest.update(content)
        if "model.onnx" in {chosen.graph for chosen in info.passes.values()}:
            graphs["model.onnx"] = graph
        return cls(info=info, graph=graph, sha256=digest.hexdigest(), graphs=graphs, data=data)


def _parse(text: bytes, where: str) -> ModelInfo:
    try:
        return ModelInfo.model_validate(json.loads(text))
    except ValidationError as error:
        raise ModelError(
            Problem("bad-model-json", f"{where}/model.json", f"{_path(e['loc'])}: {e['msg']}", "Correct the field.")
            for e in error.errors()[:_MAX_PROBLEMS]
        ) from error
    except (ValueError, RecursionError) as error:
        raise bundle_error("bad-model-json", f"{where}/model.json", f"it is not valid JSON ({error})") from error


def _add_data(data: dict[str, bytes], files: BundleFiles, name: str, graph: bytes) -> None:
    """Read the files that a graph takes weights from, as far as ``data`` lacks them."""
    place = f"{files.where}/{name}"
    try:
        tensors = external_tensors(graph)
    except ValueError as error:
        remedy = "External data lies in plain files beside the graph; export it again so, or with the weights inside."
        raise ModelError(Problem("bad-external-data", place, str(error), remedy)) from error
    for tensor in tensors:
        if tensor.location not in data:
            data[tensor.location] = files.read(tensor.location, MAX_MODEL_BYTES, linked=False)
        held = len(data[tensor.location])
        if tensor.offset + tensor.size > held:
            what = f"tensor '{tensor.name}' ends at byte {tensor.offset + tensor.size} of {tensor.location}, "
            raise bundle_error("bad-external-data", place, what + f"which has {held}")


def _path(location: tuple[int | str, ...]) -> str:
    return ".".join(shown(str(part)) for part in location) or "model.json"
