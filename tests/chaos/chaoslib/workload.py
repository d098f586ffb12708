"""Small jobs: a few simulated drives, a network that tells classes by colour, every preset and format."""

import json
import shutil
import zipfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from l3ps.simulate import simulate_drive

DRIVES = 6
PRESETS = ("fast", "best")
FORMATS = ("nuscenes", "semantickitti")
POISON_SCENES = 3


@dataclass(frozen=True, order=True)
class Case:
    """What one job is to do: the same case gives the same labels."""

    drive: int
    preset: str
    format: str

    def __str__(self) -> str:
        return f"drive {self.drive}, {self.preset}, {self.format}"


CASES = [Case(*case) for case in product(range(DRIVES), PRESETS, FORMATS)]


@dataclass(frozen=True)
class Workload:
    """Archives to upload."""

    drives: list[bytes]
    long_drive: bytes
    model: bytes


def make(folder: Path) -> Workload:
    """Simulate the drives and build the network; what is in the folder already is taken."""
    folder.mkdir(parents=True, exist_ok=True)
    drives = [drive(folder / f"drive-{n}", scenes=1, scans=2, seed=n + 1) for n in range(DRIVES)]
    return Workload(drives, drive(folder / "long", scenes=POISON_SCENES, scans=1, seed=99), _model(folder / "m.zip"))


def drive(folder: Path, **simulation: int) -> bytes:
    """An archive of a simulated drive; the one beside ``folder`` if there is one."""
    archive = folder.with_suffix(".zip")
    if not archive.exists():
        simulate_drive(folder, width=160, **simulation)
        shutil.make_archive(str(folder), "zip", folder)
        shutil.rmtree(folder)
    return archive.read_bytes()


def _model(path: Path) -> bytes:
    height, width = 48, 80
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, height, width])
    weights = numpy_helper.from_array(np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1), "w")
    graph = helper.make_graph([helper.make_node("Conv", ["image", "w"], ["logits"])], "g", [image], [logits], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return bundle(path, model.SerializeToString(), height, width)


def bundle(path: Path, graph: bytes, height: int, width: int) -> bytes:
    """A model bundle around a graph of three classes."""
    classes = {"car": 4, "vegetation": 16, "road": 11}
    info = {
        "name": "colours",
        "input": {"name": "image", "height": height, "width": width},
        "output": {"semantic": "logits"},
        "classes": list(classes),
        "to_nuscenes": classes,
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("model.onnx"), graph)
        archive.writestr(zipfile.ZipInfo("model.json"), json.dumps(info))
    return path.read_bytes()
