"""One training from annotations to bundle: the whole path on one page."""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from l3ps.errors import InputError, Problem
from l3ps.segment.bundle import InputSpec
from l3ps.segment.images import network_input

from . import report as reports
from .annotations import AnnotationSet, Format, opened_annotations, spread
from .backbones import Backbone, open_backbone
from .bundle import BALANCED, describe, write_description
from .checks import check_apart, check_classes, check_name, check_out, fingerprints
from .export import Network, agreement, write_graph
from .heads import HEADS
from .quantise import KEPT_WITHIN, quantise
from .recipe import RECIPES, Recipe, default_recipe
from .reporting import Reporter
from .training import train
from .validation import early_figure, score_graph

Size = tuple[int, int]
WORK = ".training"
COMPARED_IMAGES = 2
GRAPH = "model.onnx"


@dataclass(frozen=True)
class Request:
    """What a user asks for; see ``l3ps train --help``."""

    annotations: Path
    backbone: str
    out: Path
    name: str | None = None
    weights: Path | None = None
    recipe: str | None = None
    classes: Path | None = None
    format: Format = "auto"
    images: int | None = None
    validation: Path | float | None = None
    size: Size | None = None
    balanced: Size | None = None
    epochs: int | None = None
    seed: int = 0
    threads: int = 2
    int8: bool = False
    fresh: bool = False


def run(
    request: Request, report: Reporter, warn: Callable[[Problem], None] = lambda problem: None
) -> dict[str, Any]:  # fmt: skip
    """Train a network and write its bundle and report.

    Args:
        request: what to do.
        report: told how it goes; may raise to stop.
        warn: told what does not stop the work.

    Returns:
        The report.

    Raises:
        InputError: something of the request cannot be used.
        Cancelled: from ``report``; the same request goes on where this one stopped.
        ProcessingError: the exported graph is not the network that was trained.
    """
    with ExitStack() as opened:
        known, unseen = _annotations(request, opened)
        for problem in known.notes:
            warn(problem)
        if missing := known.missing():
            what = f"{', '.join(missing)} never occur in the training images, so the network will never find them"
            warn(Problem("missing-classes", request.annotations.name, what, "Annotate some.", severity="warning"))
        return fit(request, known, unseen, report)


def fit(request: Request, known: AnnotationSet, unseen: AnnotationSet | None, report: Reporter) -> dict[str, Any]:
    """Train on images that are open already; as :func:`run`.

    Args:
        request: what to do; its ``annotations`` are not looked at.
        known: images to learn from.
        unseen: images to score on, of the same classes.
        report: told how it goes; may raise to stop.
    """
    check_name(_name(request))
    work = _work_folder(request)
    check_classes(known)
    seen = fingerprints(known)
    check_apart(seen, [] if unseen is None else fingerprints(unseen))
    torch.set_num_threads(request.threads)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # without it cuBLAS adds up in any order
    torch.use_deterministic_algorithms(True, warn_only=True)  # CUDA has no such way for some enlargements
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    recipe_name, recipe = _recipe(request, device)
    backbone = _backbone(request, recipe, known).to(device)
    if request.balanced is not None:
        backbone.check(request.balanced, "--balanced")
    torch.manual_seed(request.seed)
    heads = HEADS[recipe.heads](
        backbone.channels, len(known.classes), boundary=known.has_instances, stride=backbone.stride
    ).to(device)
    course = train(
        backbone, heads, known, recipe, work, _settings(request, recipe, backbone, known, seen),
        seed=request.seed, device=device, report=report,
        score=early_figure(backbone, heads, unseen, device) if unseen else None,
    )  # fmt: skip
    network = Network(backbone.cpu(), heads.cpu())
    delivered = _deliver(request, network, recipe, known, unseen, work, report)
    result = {
        "name": _name(request),
        "backbone": backbone.name,
        "backbone_sha256": backbone.identity,
        "recipe": recipe_name,
        "settings": asdict(recipe),
        "seed": request.seed,
        "images": len(known.images),
        "has_instances": known.has_instances,
        "classes": list(known.classes.names[1:]),
        "never_occur": list(known.missing()),
        "input": backbone.spec.model_dump(mode="json"),
        "steps": course.steps,
        "views": course.views,
        "losses": course.losses,
        "early_miou": course.scores,
        "head_parameters": sum(p.numel() for p in heads.parameters()),
        "threads": request.threads,
        "device": torch.cuda.get_device_name() if device.type == "cuda" else platform.machine(),
        "torch": torch.__version__,
        **delivered,
    }
    result["seconds"] = {k: round(v, 1) for k, v in (course.seconds | delivered["seconds"]).items()}
    reports.write(request.out, result)
    return result


def _annotations(request: Request, opened: ExitStack) -> tuple[AnnotationSet, AnnotationSet | None]:
    """Images to learn from and images to score on."""

    def read(path: Path, images: int | None) -> AnnotationSet:
        return opened.enter_context(
            opened_annotations(path, format=request.format, classes=request.classes, images=images)
        )

    if isinstance(request.validation, float):
        whole = read(request.annotations, None)
        count = len(whole.images)
        kept = set(spread(count, max(1, round(count * request.validation))))
        rest = [i for i in range(count) if i not in kept]
        if not rest:
            what = f"a share of {request.validation} of {count} images leaves none to learn from"
            raise InputError(Problem("out-of-range", "--validation", what, "Give more images, or a folder of others."))
        chosen = [rest[i] for i in spread(len(rest), request.images)]
        return whole.subset(chosen), whole.subset(sorted(kept))
    known = read(request.annotations, request.images)
    if request.validation is None:
        return known, None
    unseen = read(request.validation, None)
    if unseen.classes != known.classes:
        what = "its classes are not those of the training images"
        remedy = "Use annotations of the same classes, or name them with --classes."
        raise InputError(Problem("other-classes", str(request.validation), what, remedy))
    return known, unseen


def _recipe(request: Request, device: torch.device) -> tuple[str, Recipe]:
    name = request.recipe or default_recipe(request.backbone, cuda=device.type == "cuda")
    if name not in RECIPES:
        what = f"there is no recipe '{name}'"
        raise InputError(Problem("unknown-recipe", "--recipe", what, f"Use one of {', '.join(RECIPES)}."))
    recipe = RECIPES[name]
    return name, recipe if request.epochs is None else replace(recipe, epochs=request.epochs)


def _backbone(request: Request, recipe: Recipe, known: AnnotationSet) -> Backbone:
    if request.int8 and request.validation is None:
        what = "int8 is kept only where validation shows that it costs little, and there are no validation images"
        raise InputError(Problem("no-validation", "--int8", what, "Name some with --validation."))
    if request.weights is not None and not request.backbone.startswith("dinov2"):
        what = f"the backbone {request.backbone} takes no weights file"
        raise InputError(Problem("bad-option", "--weights", what, "Leave it out."))
    torch.manual_seed(request.seed)
    rows, columns = known.images[0].load().semantic.shape
    return open_backbone(
        request.backbone, request.weights, request.size,
        default_size=recipe.size, aspect=columns / rows, threads=request.threads,
    )  # fmt: skip


def _work_folder(request: Request) -> Path:
    work = request.out / WORK
    check_out(request.out, work)
    if request.fresh and work.exists():
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    return work


def _settings(
    request: Request, recipe: Recipe, backbone: Backbone, known: AnnotationSet, seen: list[str]
) -> dict[str, Any]:
    """Everything that decides the weights, for the checkpoint."""
    return {
        "backbone": backbone.name,
        "weights": backbone.identity,
        "size": [backbone.spec.height, backbone.spec.width],
        "recipe": asdict(recipe),
        "seed": request.seed,
        "classes": known.classes.names,
        "images": seen,
        "instances": known.has_instances,
    }


def _deliver(
    request: Request, network: Network, recipe: Recipe, known: AnnotationSet, unseen: AnnotationSet | None, work: Path,
    report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Export, compare, score, quantise; what goes into the report."""
    staging, spec, seconds = work / "bundle", network.backbone.spec, dict[str, float]()
    shutil.rmtree(staging, ignore_errors=True)
    with _timed(seconds, "export"):
        report("export", 0, 1)
        graph = staging / GRAPH
        write_graph(network, graph)
        agreed = agreement(network, graph, _inputs(known, spec), request.threads)
        balanced = None
        if request.balanced is not None:
            larger = Network(network.backbone.at(request.balanced), network.heads)
            write_graph(larger, staging / BALANCED)
            balanced = larger.backbone.spec
            agreement(larger, staging / BALANCED, _inputs(known, balanced)[:1], request.threads)
        report("export", 1, 1)
    validation = int8 = None
    if unseen is not None:
        with _timed(seconds, "validate"):
            confusion = score_graph(graph, spec, unseen, request.threads, report)
            validation = reports.scores(confusion, known.classes.names, len(unseen.images))
            if request.int8:
                int8 = _quantised(staging, spec, unseen, confusion.miou(), balanced is not None, request, report)
                if int8["kept"]:
                    validation = int8.pop("validation")
    threshold = recipe.boundary_threshold
    write_description(staging, describe(network, _name(request), known.classes, threshold, balanced))
    for file in staging.iterdir():
        file.replace(request.out / file.name)
    staging.rmdir()
    size = sum(f.stat().st_size for f in request.out.glob("model*.onnx*"))
    return {
        "agreement": asdict(agreed), "validation": validation, "int8": int8, "bytes": size, "seconds": seconds,
        "balanced": None if balanced is None else [balanced.height, balanced.width],
    }  # fmt: skip


def _quantised(
    staging: Path, spec: InputSpec, unseen: AnnotationSet, before: float, balanced: bool, request: Request,
    report: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Put int8 graphs in the place of the float ones where validation allows it."""
    candidate = staging / "int8.onnx"
    quantise(staging / GRAPH, candidate)
    confusion = score_graph(candidate, spec, unseen, request.threads, report)
    after = confusion.miou()
    kept = bool(before - after <= KEPT_WITHIN)
    if kept:
        candidate.replace(staging / GRAPH)
        if balanced:
            quantise(staging / BALANCED, staging / BALANCED)
        for weights in staging.glob("*.data"):
            weights.unlink()  # of the float graphs; in int8 even a ViT-g fits into the graph's own file
    else:
        candidate.unlink()
    figures = {"kept": kept, "miou": round(after, 2), "float_miou": round(before, 2)}
    return figures | {"validation": reports.scores(confusion, unseen.classes.names, len(unseen.images))}


def _inputs(annotations: AnnotationSet, spec: InputSpec) -> list[np.ndarray[Any, np.dtype[np.float32]]]:
    few = annotations.subset(spread(len(annotations.images), COMPARED_IMAGES))
    return [network_input(Image.fromarray(image.load().rgb), spec) for image in few.images]


def _name(request: Request) -> str:
    return request.name or f"{'onnx' if request.backbone.startswith('onnx:') else request.backbone}-few-images"


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    began = time.monotonic()
    yield
    seconds[step] = time.monotonic() - began
