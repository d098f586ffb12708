"""``l3ps simulate-images``: annotated images to train from, without a download."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from l3ps.simulate import simulate_images as write_images
from l3ps_cli.errors import clear_errors, out
from l3ps_cli.progress import bars


def simulate_images(
    output: Annotated[Path, typer.Option("--out", help="New or empty folder for the images and their labels.")],
    count: Annotated[int, typer.Option(min=1, help="Images, each of a street of its own.")] = 30,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same images.")] = 0,
    choose_from: Annotated[
        int | None, typer.Option(help="Draw so many and keep those that show most of what is scarce.")
    ] = None,
) -> None:
    """Make synthetic camera images with the class and object of every pixel, as a folder that `l3ps train` takes."""
    with clear_errors(), bars() as progress:
        write_images(output, count, seed, progress, choose_from=choose_from)
    out.print(f"{count} annotated images in {output}", highlight=False)
