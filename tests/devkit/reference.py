"""Runs in the devkit's own environment: the official figures for labels in npz files, as JSON on standard output.

The evaluator is loaded by file: importing the package would pull in matplotlib, OpenCV and scikit-learn, none of which
it uses.
"""

import importlib.util
import json
import sys
import sysconfig
import types
from pathlib import Path

import numpy as np

PACKAGE = Path(sysconfig.get_paths()["purelib"]) / "nuscenes"


def load(name):
    spec = importlib.util.spec_from_file_location(Path(name).stem, PACKAGE / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def mapping(names):
    """Challenge class of each raw category, from the devkit's own mapper."""
    for stub in ("nuscenes", "nuscenes.utils", "nuscenes.utils.splits"):
        sys.modules[stub] = types.ModuleType(stub)
    sys.modules["nuscenes"].NuScenes = object
    sys.modules["nuscenes.utils.splits"].create_splits_scenes = None
    mapper = load("eval/lidarseg/utils.py").LidarsegClassMapper(
        types.SimpleNamespace(lidarseg_name2idx_mapping={name: index for index, name in enumerate(names)})
    )
    return mapper


def from_arrays(request):
    """Scans as ``t_sem_0, t_inst_0, p_sem_0, p_inst_0, …`` of one npz."""
    with np.load(request["npz"]) as scans:
        for i in range(len(scans.files) // 4):
            yield tuple(scans[f"{key}_{i}"] for key in ("t_sem", "t_inst", "p_sem", "p_inst"))


def from_files(request):
    """Scans as the official evaluation loads them: truth in raw categories, predictions in challenge classes."""
    mapper = mapping(request["names"])
    load_bin_file = load("utils/data_io.py").load_bin_file
    for truth, prediction in request["files"]:
        t, p = load_bin_file(truth, "panoptic"), load_bin_file(prediction, "panoptic")
        yield mapper.convert_label(t // 1000), t, p // 1000, p


def figures(request):
    """Official figures of scans given as arrays, or as the files of a log and of a submission."""
    evaluator = load("eval/panoptic/panoptic_seg_evaluator.py").PanopticEval(
        request["classes"], ignore=[0], min_points=request["min_points"]
    )
    for t_sem, t_inst, p_sem, p_inst in from_files(request) if "files" in request else from_arrays(request):
        evaluator.addBatch(p_sem, p_inst, t_sem, t_inst)
    _, _, _, pq, sq, rq = evaluator.getPQ()
    return {
        "pq": pq.tolist(),
        "sq": sq.tolist(),
        "rq": rq.tolist(),
        "iou": evaluator.getSemIoU()[1].tolist(),
        "tp": evaluator.pan_tp.tolist(),
        "fp": evaluator.pan_fp.tolist(),
        "fn": evaluator.pan_fn.tolist(),
    }


def main():
    request = json.load(sys.stdin)
    if request["what"] == "taxonomy":
        mapper = mapping(request["names"])
        answer = {"raw_to_class": mapper.fine_idx_2_coarse_idx_mapping, "classes": mapper.get_coarse2idx()}
        answer["colors"] = mapper.get_coarse2color()
    else:
        answer = figures(request)
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
