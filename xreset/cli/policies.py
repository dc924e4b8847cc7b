"""``xreset policies``: the cards of the policies that ship with xreset."""

from __future__ import annotations

from collections.abc import Sequence

from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.errors import PolicyError
from xreset.policy.shipped import card, shipped, shipped_graphs, shipped_name


def policies(names: Sequence[str] = ()) -> None:
    """List the policies that ship with xreset. Every command with a policy argument accepts their names.

    Args:
        names: policies to show, or robots whose name means a policy; default: all.
    """
    from xreset.policy.onnx_policy import OnnxPolicy

    files = shipped()
    graphs = shipped_graphs()  # a policy with cameras has none, and cannot be played
    chosen = []
    for given in names or files:
        name = shipped_name(given)
        if name is None:
            raise PolicyError(f"Unknown policy {given!r}. Choose from: {', '.join(files)}.")
        chosen.append(name)
    for name in dict.fromkeys(chosen):
        file = files[name]
        contract = OnnxPolicy(file).contract
        about = card(file)
        console.print(f"{name}: {about.about}")
        facts = {
            "robot": ", ".join([_robot(contract.robot, name), *contract.others]),
            "objects": _objects(contract.objects),
            "data": about.data,
            "recipe": about.recipe,
            "licence": f"{about.licence}; {file.stat().st_size / 1e6:.1f} MB",
            "try it": "xreset "
            + (f"play {name}" if name in graphs else f"eval {name} --demos DEMOS"),
        }
        for what, text in facts.items():
            console.print(f"  {what + ':':9} {text}")
        engines = []
        for by_engine in about.results.values():
            engines += [engine for engine in by_engine if engine not in engines]
        table = [("task progress", *engines)]
        for episodes, by_engine in about.results.items():
            table.append((episodes, *(by_engine.get(engine, "") for engine in engines)))
        show_table(table)


def _robot(robot: str, policy: str) -> str:
    """Return the name of a policy's robot, and whether this name means the policy."""
    if shipped_name(robot) != policy:
        return robot
    return f"{robot}, whose name means this policy"


def _objects(trained: tuple[str, ...]) -> str:
    """Return the names of the catalogue's objects, and the number of other shapes, which one training was made with."""
    from xreset.objects.catalogue import object_names

    known = [name for name in trained if name in object_names()]
    others = len(trained) - len(known)
    return ", ".join([*known, f"{others} other shapes"] if others else known)


COMMAND = verb(policies)
