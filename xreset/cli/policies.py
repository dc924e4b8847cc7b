"""``xreset policies``: the cards of those that ship with xreset, and exported ones as files."""

from __future__ import annotations

from rich.table import Table

from xreset import policy as policy_files
from xreset.cli._common import Source
from xreset.cli._terminal import console
from xreset.learning import shrink as shrinking
from xreset.policies import card, shipped


def list_() -> None:
    """List the policies that ship with xreset. Every command that takes a policy takes their names."""
    for name, file in shipped().items():
        contract = policy_files.OnnxPolicy(file).contract
        about = card(file)
        console.print(f"{name}: {about.about}")
        facts = {
            "robot": contract["robot"],
            "objects": ", ".join(contract["objects"]),
            "data": about.data,
            "recipe": about.recipe,
            "licence": f"{about.licence}; {file.stat().st_size / 1e6:.1f} MB",
        }
        for what, text in facts.items():
            console.print(f"  {what + ':':9} {text}")
        engines = list({engine: None for by_engine in about.results.values() for engine in by_engine})  # noqa: XR002
        table = Table("task progress", *engines)
        for episodes, by_engine in about.results.items():
            table.add_row(episodes, *(by_engine.get(engine, "") for engine in engines))
        console.print(table)


def shrink(policy: Source, out: Source) -> None:
    """Store a policy's weights in float16, which halves the file. The policy still computes in float32.

    Args:
        policy: Exported policy (.onnx).
        out: File to write.
    """
    before = (
        policy.stat().st_size if policy.is_file() else 0
    )  # now, for the output may replace it; of what is no file, shrinking complains
    shrinking.shrink(policy, out)
    console.print(f"{out}: {out.stat().st_size / 1e6:.2f} MB, was {before / 1e6:.2f} MB")


COMMAND = {"list": list_, "shrink": shrink}
