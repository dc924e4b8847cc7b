"""``make_shapes``, a function and a command: its signature has the options, its docstring the help.

It imports most of what it needs when it is called, because the help of a command is shown at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from xreset.errors import ObjectError
from xreset.files.checks import Option, Output, PositiveInt, Seed, obeys_rules
from xreset.files.storage import atomic_folder

MOST = 10_000
"""Most shapes of one folder."""


@obeys_rules
def make_shapes(
    out: Annotated[Output, Option("out")], count: PositiveInt = 40, seed: Seed = 0
) -> list[Path]:
    """Make random shapes to train with: boxes, cans, cups, eggs, wedges, bottles, hammers and bananas.

    Demonstrations of them: xreset demos synth --meshes FOLDER. The families take turns. The same seed gives the same
    shapes, and a shape does not depend on the number of shapes.

    Args:
        out: folder of objects to make.
        count: number of shapes.
        seed: seed of sizes and masses.

    Returns:
        The meshes NAME.obj, in order; the mass of each is in NAME.toml.

    Raises:
        ObjectError: there are too many shapes.
        XResetError: the folder exists.
    """
    from xreset.objects.procedural import write_shape

    out = Path(out)
    if count > MOST:
        raise ObjectError(f"count is {count}, expected a number from 1 to {MOST}.")
    with atomic_folder(out) as folder:
        names = [write_shape(folder, number, seed).name for number in range(count)]
    return [out / name for name in names]
