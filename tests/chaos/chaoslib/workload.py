"""Small jobs: a few simulated drives, a network that tells classes by colour, every preset and format."""

import io
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
    annotations: bytes


def make(folder: Path) -> Workload:
    """Simulate the drives and build the network; what is in the folder already is taken."""
    folder.mkdir(parents=True, exist_ok=True)
    drives = [drive(folder / f"drive-{n}", scenes=1, scans=2, seed=n + 1) for n in range(DRIVES)]
    long_drive = drive(folder / "long", scenes=POISON_SCENES, scans=1, seed=99)
    return Workload(drives, long_drive, _model(folder / "m.zip"), _annotations())


def drive(folder: Path, **simulation: int) -> bytes:
    """An archive of a simulated drive; the one beside ``folder`` if there is one."""
    archive = folder.with_suffix(".zip")
    if not archive.exists():
        simulate_drive(folder, width=160, **simulation)
        shutil.make_archive(str(folder), "zip", folder)
        shutil.rmtree(folder)
    return archive.read_bytes()


def _annotations() -> bytes:
    """Four annotated pictures: trees over a road, a bright car somewhere on it."""
    from PIL import Image

    trees, road, car = 16, 11, 4
    rng, out = np.random.default_rng(4), io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for number in range(4):
            semantic = np.full((64, 96), trees, np.uint8)
            semantic[32:] = road
            row, column = rng.integers(28, 44), rng.integers(4, 70)
            semantic[row : row + 12, column : column + 20] = car
            colours = np.zeros((256, 3), np.uint8)
            colours[[trees, road, car]] = (20, 120, 20), (90, 90, 90), (240, 240, 250)
            picture = (colours[semantic] + rng.integers(-12, 13, (64, 96, 3))).clip(0, 255).astype(np.uint8)
            for folder, image in (("images", picture), ("semantic", semantic)):
                with archive.open(zipfile.ZipInfo(f"{folder}/{number}.png"), "w") as file:
                    Image.fromarray(image).save(file, "PNG")
    return out.getvalue()


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
