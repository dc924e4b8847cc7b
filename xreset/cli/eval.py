"""``xreset eval``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from xreset.cli._terminal import console
from xreset.cli._verbs import verb
from xreset.eval import verbs

if TYPE_CHECKING:
    from xreset.eval.results import Evaluation


def _write_into_default_folder(arguments: dict[str, Any]) -> None:
    from xreset.eval.policy_spec import load_policy

    if arguments["out"] is None:
        policy = load_policy(arguments["policy"], robot=arguments["robot"])
        arguments["policy"] = policy
        arguments["out"] = policy.folder


def _show(results: Evaluation, _options: Mapping[str, Any]) -> None:
    from xreset.eval import table

    console.print(table.results_table(results))
    if unseen := results[0].unseen:
        console.print(f"not in the policy's training: {', '.join(unseen)}")
    console.print(f"results in {results.folder}")


COMMAND = verb(verbs.evaluate, _show, prepare=_write_into_default_folder)
