"""``python -m l3ps_trainer``: train, and what belongs to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import typer
from rich.console import Console

from l3ps.errors import Cancelled, InputError, Problem, ProcessingError

from .annotations import Format
from .reporting import Events, Reporter, bars, stoppable

FAILED, BAD_INPUT = 1, 2
"""Exit codes that callers rely on; a run stopped by a signal ends with 128 + its number."""

app = typer.Typer(name="l3ps_trainer", no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)


model = typer.Typer(no_args_is_help=True, help="Make bundles otherwise than by training.")
app.add_typer(model, name="model")


@app.callback()
def trainer() -> None:
    """Few annotated images in, a fast CPU model out."""


def parsed_size(text: str, option: str) -> tuple[int, int]:
    """(height, width) from ``HxW``.

    Raises:
        InputError: it is something else.
    """
    rows, _, columns = text.lower().partition("x")
    if not (rows.isdecimal() and columns.isdecimal() and 0 < int(rows) <= 8192 and 0 < int(columns) <= 8192):
        what = f"'{text}' is no size"
        raise InputError(Problem("bad-size", option, what, "Give height and width in pixels, such as 448x798."))
    return int(rows), int(columns)


@app.command()
def train(
    annotations: Annotated[Path, typer.Argument(help="Annotated images: a folder or archive.")],
    out: Annotated[Path, typer.Option(help="Folder for the bundle and the report.")],
    backbone: Annotated[str, typer.Option(help="dinov2-s|b|l|g with optional -reg, onnx:PATH, or scratch.")],
    name: Annotated[str | None, typer.Option(help="Of the model.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Official .pth of the DINOv2; downloaded when left out.")] = None,
    recipe: Annotated[str | None, typer.Option(help="Recipe by name; chosen by backbone when left out.")] = None,
    classes: Annotated[Path | None, typer.Option(help="Classes file, where the annotations bring none.")] = None,
    layout: Annotated[str, typer.Option("--format", help="auto, plain, cityscapes, coco or nuimages.")] = "auto",
    images: Annotated[int | None, typer.Option(min=1, help="Learn from so many, spread evenly over all.")] = None,
    validation: Annotated[
        str | None, typer.Option(help="Annotated images to score on, or a share such as 0.2.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="HxW of the network's input.")] = None,
    balanced: Annotated[str | None, typer.Option(help="HxW of a second graph, for the preset balanced.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="In place of the recipe's.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random.")] = 0,
    threads: Annotated[int, typer.Option(min=1, max=256, help="CPU threads.")] = 2,
    int8: Annotated[bool, typer.Option("--int8", help="Deliver int8 products if validation allows it.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Start over where a training was begun.")] = False,
    events: Annotated[bool, typer.Option("--events", help="JSON lines on standard output, for programs.")] = False,
) -> None:
    """Train heads on annotated images and write a model bundle; the same command again resumes after a kill."""
    with _ending(events) as (report, done, warn):
        from .run import Request, run  # noqa: PLC0415  (torch takes seconds to import, which --help need not wait for)

        request = Request(
            annotations, backbone, out, name, weights, recipe, classes, _format(layout), images,
            _kept_apart(validation),
            None if size is None else parsed_size(size, "--size"),
            None if balanced is None else parsed_size(balanced, "--balanced"),
            epochs, seed, threads, int8, fresh,
        )  # fmt: skip
        done(run(request, report, warn), out)


@contextmanager
def _ending(
    events: bool,
) -> Iterator[tuple[Reporter, Callable[[dict[str, Any], Path], None], Callable[[Problem], None]]]:
    """How a command reports and ends: 0 done, 2 bad input, 128 + number of the signal that stopped it."""
    console = Console(stderr=True)
    with stoppable() as stop, ExitStack() as display:
        lines = Events(stop)
        report: Reporter = lines if events else display.enter_context(bars(stop, console))

        def done(result: dict[str, Any], out: Path) -> None:
            if events:
                lines.done(result)
            display.close()
            console.print((out / "report.md").read_text(), markup=False, highlight=False)

        try:
            yield report, done, partial(_warn, console)
        except (InputError, OSError) as error:
            wrong = error if isinstance(error, InputError) else _unusable(error)
            display.close()
            if events:
                lines.failed(wrong)
            for problem in wrong.problems:
                console.print(str(problem), style="red", markup=False, highlight=False, soft_wrap=True)
            raise typer.Exit(BAD_INPUT) from error
        except (Cancelled, ProcessingError) as error:
            display.close()
            console.print(str(error), style="red", markup=False, highlight=False, soft_wrap=True)
            raise typer.Exit(FAILED if stop.signal is None else 128 + stop.signal) from error


def _unusable(error: OSError) -> InputError:
    """A file that cannot be used, as the user's; any other failure of the system is a defect."""
    if error.filename is None:
        raise error
    what = error.strerror or "it cannot be used"
    return InputError(Problem("bad-file", str(error.filename), what, "Name a place that exists and that you may use."))


def _warn(console: Console, problem: Problem) -> None:
    console.print(f"Warning: {problem}", style="yellow", markup=False, highlight=False, soft_wrap=True)


def _format(name: str) -> Format:
    if name not in get_args(Format):
        what = f"there is no '{name}'"
        raise InputError(Problem("unknown-format", "--format", what, f"Use one of {', '.join(get_args(Format))}."))
    return cast(Format, name)


def _kept_apart(text: str | None) -> Path | float | None:
    """A folder, or a share of the images."""
    try:
        share = float(text or "")
    except ValueError:
        return None if text is None else Path(text)
    if not 0 < share < 1:
        what = f"{text} is no share of the images"
        raise InputError(Problem("out-of-range", "--validation", what, "Give one between 0 and 1, or a folder."))
    return share


@model.command("import-pastel")
def import_pastel(
    semantic: Annotated[Path, typer.Argument(help="Lightning checkpoint of the semantic head.")],
    boundary: Annotated[Path, typer.Argument(help="Lightning checkpoint of the boundary head.")],
    out: Annotated[Path, typer.Option(help="Folder for the bundle.")],
    name: Annotated[str, typer.Option(help="Of the model.")] = "pastel",
    size: Annotated[str, typer.Option(help="HxW of the input, multiples of 14.")] = "896x1596",
    classes: Annotated[Path | None, typer.Option(help="Classes file; void, nuScenes-16 and sky when left out.")] = None,
    threads: Annotated[int, typer.Option(min=1, max=256, help="CPU threads.")] = 2,
) -> None:
    """Turn the authors' published checkpoints into a bundle that runs their encoder once for both heads."""
    with _ending(events=False) as (report, _, _):
        import torch  # noqa: PLC0415

        from .pastel import import_checkpoints  # noqa: PLC0415

        torch.set_num_threads(threads)
        report("export", 0, 1)
        agreed = import_checkpoints(semantic, boundary, out, name, parsed_size(size, "--size"), classes, threads)
        report("export", 1, 1)
    typer.echo(f"{out}: torch and ONNX Runtime differ by at most {agreed.probability:.1e} in any value", err=True)


@model.command("speed-bundle")
def speed_bundle(
    out: Annotated[Path, typer.Option(help="Folder for the bundle.")],
    backbone: Annotated[str, typer.Option(help="A DINOv2, such as dinov2-s.")] = "dinov2-s",
    size: Annotated[str, typer.Option(help="HxW of the input, multiples of 14.")] = "448x798",
    heads: Annotated[str, typer.Option(help="Heads by name.")] = "narrow",
    int8: Annotated[bool, typer.Option("--int8", help="Quantise the products.")] = False,
) -> None:
    """Write a bundle with random weights, for measuring speed only."""
    from .speed import write_speed_bundle  # noqa: PLC0415  (torch takes seconds to import, which --help need not wait for)

    graph = write_speed_bundle(out, backbone, parsed_size(size, "--size"), heads, int8=int8)
    typer.echo(f"{graph}: random weights, for measuring speed only", err=True)
