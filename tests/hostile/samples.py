"""The good things that hostile ones are made of: a small log and a small model, as files in memory."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .archives import Files, tarred, zipped

TABLES = "v1.0-mini"


@dataclass(frozen=True)
class Samples:
    """A log of one scene of three scans, and a bundle that passes its check."""

    log: Files
    bundle: Files

    def scans(self) -> list[str]:
        """Names of the point files."""
        return sorted(name for name in self.log if "LIDAR_TOP" in name)

    def images(self, channel: str = "CAM_FRONT/") -> list[str]:
        """Names of the images of one camera."""
        return sorted(name for name in self.log if channel in name)

    def zip(self, **changed: bytes) -> bytes:
        """The log."""
        return zipped(self.log | changed)

    def tar(self) -> bytes:
        """The log."""
        return tarred(self.log)

    def rows(self, table: str) -> list[Any]:
        """A table's rows, to be changed."""
        rows: list[Any] = json.loads(self.log[f"{TABLES}/{table}.json"])
        return rows

    def with_table(self, table: str, text: str | bytes | list[Any] | dict[str, Any]) -> bytes:
        """The log with another table of that name."""
        if not isinstance(text, str | bytes):
            text = json.dumps(text)
        content = text if isinstance(text, bytes) else text.encode()
        return zipped(self.log | {f"{TABLES}/{table}.json": content})

    def with_rows(self, table: str, change: Callable[[dict[str, Any]], object]) -> bytes:
        """The log with every row of a table changed."""
        rows = self.rows(table)
        for row in rows:
            change(row)
        return self.with_table(table, rows)

    def with_points(self, change: Callable[[Any], Any]) -> bytes:
        """The log with every scan changed; a scan is (N, 5) float32."""
        changed = dict(self.log)
        for name in self.scans():
            points = np.frombuffer(self.log[name], "<f4").reshape(-1, 5).copy()
            changed[name] = np.asarray(change(points), "<f4").tobytes()
        return zipped(changed)

    def with_images(self, change: Callable[[bytes], bytes], channel: str = "CAM_") -> bytes:
        """The log with every image of some cameras changed."""
        names = self.images(channel)
        return zipped(self.log | {name: change(self.log[name]) for name in names})

    def without(self, part: str) -> bytes:
        """The log without the files whose names hold this."""
        return zipped({name: content for name, content in self.log.items() if part not in name})

    def model(self, description: dict[str, Any] | None = None, **files: bytes) -> bytes:
        """The bundle, with other fields in its description or other files (``model_onnx`` stands for model.onnx)."""
        told = json.loads(self.bundle["model.json"]) | (description or {})
        named = {name.replace("_", ".", 1): content for name, content in files.items()}
        return zipped({**self.bundle, "model.json": json.dumps(told).encode(), **named})


def read_folder(folder: Path, leave_out: str = "maps") -> Files:
    """The files below a folder by name."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and leave_out not in path.parts)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
