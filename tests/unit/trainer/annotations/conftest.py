"""Tiny folders of every format, sound ones, for tests to break."""

import base64
import json
from itertools import groupby

import numpy as np
import pytest
from PIL import Image

HEIGHT, WIDTH = 6, 9


def rgb(seed=0):
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def halves(left, right, dtype=np.int64):
    """A label map whose left four columns have one id."""
    return np.where(np.arange(WIDTH) < 4, left, right)[None].repeat(HEIGHT, 0).astype(dtype)


def save(path, array):
    """Write an array as the file's ending says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, array)
    else:
        Image.fromarray(array.astype(np.uint8) if array.dtype == np.int64 else array).save(path)


def rows(path, change):
    """Rewrite a JSON file in place; a table may be replaced by another list."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(changed if isinstance(content, list) and isinstance(changed, list) else content))


@pytest.fixture
def plain(tmp_path):
    """Two images of a car (id 4) beside road (11), objects annotated."""
    folder = tmp_path / "plain"
    for i, name in enumerate(("a", "b")):
        save(folder / "images" / f"{name}.png", rgb(i))
        save(folder / "semantic" / f"{name}.png", halves(4, 11))
        save(folder / "instance" / f"{name}.npy", halves(300, 0))
    return folder


@pytest.fixture
def cityscapes(tmp_path):
    """Two images of two cities: a car (26) beside road (7)."""
    root = tmp_path / "cityscapes"
    for i, city in enumerate(("ulm", "bochum")):
        stem = f"{city}_000000_00001{i}"
        save(root / "leftImg8bit" / "train" / city / f"{stem}_leftImg8bit.png", rgb(i))
        save(root / "gtFine" / "train" / city / f"{stem}_gtFine_labelIds.png", halves(26, 7))
        save(root / "gtFine" / "train" / city / f"{stem}_gtFine_instanceIds.png", halves(26001, 7, np.uint16))
    return root


def colours(ids):
    """Segment ids as COCO colours them."""
    ids = np.asarray(ids, int)
    return np.stack([ids % 256, ids // 256 % 256, ids // 65536], axis=-1).astype(np.uint8)


@pytest.fixture
def coco(tmp_path):
    """Two images of a car (category 3) beside road (149)."""
    root = tmp_path / "coco"
    images, annotations = [], []
    for i in range(2):
        save(root / "val2017" / f"{i}.png", rgb(i))
        save(root / "annotations" / "panoptic_val2017" / f"{i}.png", colours(halves(3_226_956, 7)))
        images.append({"id": i, "file_name": f"{i}.png", "width": WIDTH, "height": HEIGHT})
        segments = [{"id": 3_226_956, "category_id": 3, "iscrowd": 0}, {"id": 7, "category_id": 149, "iscrowd": 0}]
        annotations.append({"image_id": i, "file_name": f"{i}.png", "segments_info": segments})
    categories = [{"id": 3, "name": "car", "isthing": 1}, {"id": 149, "name": "road", "isthing": 0}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (root / "annotations" / "panoptic_val2017.json").write_text(json.dumps(content))
    return root


def packed(mask):
    """A mask in COCO's characters: an encoder as plain as can be, number by number, bit by bit."""
    runs = [(value, len(list(run))) for value, run in groupby(np.asarray(mask, bool).T.ravel().tolist())]
    counts = [0] * bool(runs and runs[0][0]) + [length for _, length in runs]
    text = ""
    for i, count in enumerate(counts):
        x, more = count - (counts[i - 2] if i > 2 else 0), True
        while more:
            digit, x = x & 31, x >> 5
            more = x != (-1 if digit & 16 else 0)
            text += chr(48 + digit + (32 if more else 0))
    return text.encode()


def mask_column(mask):
    return {"size": list(mask.shape), "counts": base64.b64encode(packed(mask)).decode()}


@pytest.fixture
def nuimages(tmp_path):
    """One annotated image: road everywhere, a car over it and a pedestrian over the car; and one that is not."""
    root = tmp_path / "nuimages"
    tables = root / "v1.0-mini"
    tables.mkdir(parents=True)
    data = [
        {"token": f"d{i}", "filename": f"samples/CAM_FRONT/{i}.png", "is_key_frame": True, "sample_token": "s"}
        for i in range(2)
    ]
    for i in range(2):
        save(root / "samples" / "CAM_FRONT" / f"{i}.png", rgb(i))
    names = ["flat.driveable_surface", "vehicle.car", "human.pedestrian.adult", "animal"]
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    person = np.zeros((HEIGHT, WIDTH), bool)
    person[2:4, 2:6] = True
    objects = [  # painted by token: car, then pedestrian
        {"token": "o2", "category_token": "c2", "sample_data_token": "d0", "mask": mask_column(person)},
        {"token": "o1", "category_token": "c1", "sample_data_token": "d0", "mask": mask_column(halves(1, 0) == 1)},
        {"token": "o3", "category_token": "c3", "sample_data_token": "d0", "mask": None},
    ]
    surfaces = [{"token": "s1", "category_token": "c0", "sample_data_token": "d0", "mask": mask_column(everywhere)}]
    content = {
        "sample_data": data,
        "category": [{"token": f"c{i}", "name": name} for i, name in enumerate(names)],
        "object_ann": objects,
        "surface_ann": surfaces,
    }
    for name, table in content.items():
        (tables / f"{name}.json").write_text(json.dumps(table))
    return root
