"""``xreset policies``: the cards of those that ship with xreset, and exported ones as files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from xreset import policy as policy_files
from xreset.cli._terminal import Console
from xreset.learning import shrink as shrinking
from xreset.policies import card, shipped


def list_() -> None:
    """Show the cards of the policies that ship with xreset; wherever a policy is asked for, their names will do."""
    console = Console()
    for name, file in shipped().items():
        contract, about = policy_files.OnnxPolicy(file).contract, card(file)
        console.print(f"{name}: {about.about}", highlight=False)
        facts = {
            "robot": contract["robot"],
            "objects": ", ".join(contract["objects"]),
            "data": about.data,
            "recipe": about.recipe,
            "licence": f"{about.licence}; {file.stat().st_size / 1e6:.1f} MB",
        }
        for what, text in facts.items():
            console.print(f"  {what + ':':9} {text}", highlight=False, soft_wrap=True)
        engines = list(dict.fromkeys(engine for by_engine in about.results.values() for engine in by_engine))
        table = Table("task progress", *engines)
        for episodes, by_engine in about.results.items():
            table.add_row(episodes, *(by_engine.get(engine, "") for engine in engines))
        console.print(table)


def shrink(policy: Annotated[Path, tyro.conf.Positional], out: Annotated[Path, tyro.conf.Positional]) -> None:
    """Store a policy's weights in float16, which halves the file; they are computed with in float32 as before.

    Args:
        policy: Exported policy (.onnx).
        out: File to write.
    """
    before = (
        policy.stat().st_size if policy.is_file() else 0
    )  # now, for the output may replace it; of what is no file, shrinking complains
    shrinking.shrink(policy, out)
    Console().print(
        f"{out}: {out.stat().st_size / 1e6:.2f} MB, was {before / 1e6:.2f} MB", highlight=False, soft_wrap=True
    )


COMMAND = {"list": list_, "shrink": shrink}
