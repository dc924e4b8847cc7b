"""``xreset stress``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from xreset.cli._common import write_next_to_policy
from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.eval import verbs
from xreset.eval.conditions import plays_on_robot
from xreset.files.text import quantity

if TYPE_CHECKING:
    from xreset.eval import effects
    from xreset.eval.results import Evaluation


def _write_into_default_folder(arguments: dict[str, Any]) -> None:
    has_faults = plays_on_robot(arguments.get("properties", ()), arguments["faults"])
    write_next_to_policy(arguments, "faults" if has_faults else "stress")


def _show(found: Evaluation, _options: Mapping[str, Any]) -> None:
    from xreset.eval import effects

    rows = [("property", "value", *(result.engine for result in found))]
    for name, curves in effects.by_property(found).items():
        known = next(filter(None, curves))
        for i, point in enumerate(known.points):
            cells = []
            for curve in curves:
                cells.append(_cell(curve, i) if curve else "cannot be set")
            rows.append((name, known.property.amount(point.value), *cells))
        limits = [curve.costs() if curve else "" for curve in curves]
        rows.append(("", "costs ten points", *limits))
    title = f"{found[0].policy}: task progress, and its difference to the same episodes in points (95 %)"
    episodes = quantity(len(found[0].nominal), "episode")
    show_table(rows, title=f"{title}\n{episodes}, seed {found[0].seed}")
    for result in found:
        if result.left_out:
            console.print(
                f"left out in {result.engine}, which cannot set them: {', '.join(result.left_out)}"
            )
    sentence, reasons = effects.verdict(found)
    if sentence:
        console.print(sentence, style="bold")
    for reason in reasons:
        console.print(reason)
    console.print(f"results in {found.folder}; page with every curve: xreset report {found.folder}")


def _cell(curve: effects.Curve, index: int) -> str:
    """Return task progress as text; at other than the nominal value, with the difference to it and its interval."""
    from xreset.eval.table import points_text

    point = curve.points[index]
    text = f"{100 * point.task_progress:.1f} %"
    if point.value == curve.property.nominal:
        return text
    return f"{text}, {points_text(point.difference, *point.difference_ci95)}"


COMMAND = verb(verbs.stress, _show, prepare=_write_into_default_folder)
