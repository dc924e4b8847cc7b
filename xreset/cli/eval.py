"""``xreset eval``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from xreset.cli._common import write_next_to_policy
from xreset.cli._terminal import console
from xreset.cli._verbs import verb
from xreset.eval import verbs

if TYPE_CHECKING:
    from xreset.eval.results import Evaluation


def _show(results: Evaluation, _options: Mapping[str, Any]) -> None:
    from xreset.eval import table

    console.print(table.results_table(results))
    if unseen := results[0].unseen:
        console.print(f"not in the policy's training: {', '.join(unseen)}")
    console.print(f"results in {results.folder}")


COMMAND = verb(verbs.evaluate, _show, prepare=write_next_to_policy)
