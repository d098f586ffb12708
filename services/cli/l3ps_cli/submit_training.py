"""``l3ps submit-training``: annotated images to a running service, and back a model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from l3ps.errors import InputError, Problem
from l3ps_cli.console import BAD_INPUT, JOB_FAILED, err, fail, out, service_errors
from l3ps_cli.errors import INTERRUPTED
from l3ps_cli.submit import check_log, upload_log
from l3ps_cli.watch import wait_for_training
from l3ps_client import Client, Training, sentences


def submit_training(
    annotations: Annotated[Path, typer.Argument(help="Annotated images: a directory or an archive.")],
    *,
    name: Annotated[str, typer.Option(help="What the model is to be called.")],
    backbone: Annotated[str, typer.Option(help="A backbone that the service has, or scratch.")],
    validation: Annotated[
        str | None, typer.Option(help="Annotated images to measure on, or a share to set aside such as 0.2.")
    ] = None,
    recipe: Annotated[str | None, typer.Option(help="Name of a recipe.", show_default=False)] = None,
    classes: Annotated[Path | None, typer.Option(help="JSON file that says what the numbers mean.")] = None,
    format: Annotated[str, typer.Option(help="auto, plain, cityscapes, coco or nuimages.")] = "auto",
    images: Annotated[int | None, typer.Option(min=1, help="Learn from so many of the images.")] = None,
    size: Annotated[str | None, typer.Option(help="HxW of the network's input.")] = None,
    balanced: Annotated[str | None, typer.Option(help="HxW of a second input, for the preset balanced.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Rounds over the images.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all chance.")] = 0,
    int8: Annotated[bool, typer.Option("--int8", help="Quantise, where it costs next to nothing.")] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until it is over, showing progress and figures.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the training's document.")] = False,
) -> None:
    """Upload annotated images, have the service train a model on them and, with --wait, see it through.

    Exit codes: 0 done, 1 the training failed, 2 bad input, 3 the service cannot be reached.
    """
    with service_errors(), Client() as client:
        check_log(annotations, "annotated images")
        measured = _share(validation)
        if isinstance(measured, Path):
            check_log(measured, "annotated images or a share")
        settings: dict[str, Any] = {
            "format": format,
            "seed": seed,
            "int8": int8,
            "recipe": recipe,
            "classes": _classes(classes) if classes else None,
            "images": images,
            "size": _size("--size", size),
            "balanced": _size("--balanced", balanced),
            "epochs": epochs,
        }
        sent = upload_log(client, annotations, "annotations")["id"]
        checked = upload_log(client, measured, "annotations")["id"] if isinstance(measured, Path) else measured
        training = client.trainings.create(
            name=name, annotations=sent, backbone=backbone, validation=checked, **settings
        )
        if wait:
            try:
                training = wait_for_training(client, training["id"], err)
            except KeyboardInterrupt:
                fail(
                    f"Training {training['id']} goes on; `l3ps trainings {training['id']} --cancel` stops it.",
                    INTERRUPTED,
                )
    if as_json:
        out.print_json(data=training)
    elif training["state"] == "succeeded":
        out.print(f"model {training['name']}: ready", highlight=False)
    else:
        out.print(f"training {training['id']}: {training['state']}", highlight=False)
    if wait:
        _require_success(training)


def _require_success(training: Training) -> None:
    if training["state"] == "cancelled":
        fail(f"Training {training['id']} was cancelled.", JOB_FAILED)
    if training["state"] == "failed":
        why = {"detail": f"Training {training['id']} failed. {training.get('message') or ''}"}
        errors = training.get("errors")
        fail("\n".join(sentences(why | {"errors": errors})), BAD_INPUT if errors else JOB_FAILED)


def _share(validation: str | None) -> Path | float | None:
    """A share of the images, or where others are."""
    try:
        return float(validation or "")
    except ValueError:
        return None if validation is None else Path(validation)


def _classes(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        what = f"it is no JSON ({error})"
        raise InputError(Problem("bad-classes", str(path), what, "Name a file of classes.")) from error


def _size(option: str, text: str | None) -> list[int] | None:
    if text is None:
        return None
    rows, _, columns = text.partition("x")
    if not (rows.isdecimal() and columns.isdecimal()):
        what = f"'{text}' is no size"
        raise InputError(Problem("bad-size", option, what, "Give height and width in pixels, such as 448x798."))
    return [int(rows), int(columns)]
