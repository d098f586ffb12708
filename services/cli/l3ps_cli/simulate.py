"""``l3ps simulate``: drives without a download."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from l3ps.errors import InputError, Problem
from l3ps.simulate import simulate_drive
from l3ps_cli.errors import clear_errors, out
from l3ps_cli.progress import bars


def simulate(
    output: Annotated[Path, typer.Option("--out", help="New or empty folder for the drive.")],
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of the drive.")] = 1,
    scans: Annotated[int, typer.Option(min=1, help="Keyframes of each scene, two a second.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same drive, byte for byte.")] = 0,
) -> None:
    """Make a synthetic nuScenes-format drive with six cameras and panoptic truth for every point."""
    with clear_errors():
        if output.exists() and (not output.is_dir() or any(output.iterdir())):
            what = "it exists and is not an empty folder"
            raise InputError(Problem("bad-output", str(output), what, "Name a new or empty folder."))
        with bars() as progress:
            simulate_drive(output, scenes=scenes, scans=scans, seed=seed, progress=progress)
    out.print(f"{scenes} scenes of {scans} scans in {output}", highlight=False)
