"""``xreset report``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from xreset.cli._terminal import console, show_notes
from xreset.cli._verbs import verb
from xreset.eval import verbs
from xreset.files.text import short_name

if TYPE_CHECKING:
    from xreset.eval.report.make import Report


def _show(report: Report, options: Mapping[str, Any]) -> None:
    from xreset.eval import table
    from xreset.eval.report.make import headline

    if len(report.evaluated) == 1:  # xreset eval has printed its table
        console.print(headline(report.evaluated))
    else:
        for training in report.evaluated:
            console.print(table.results_table(list(training.results.values())))
    show_notes(report.notes)
    if options["film"]:
        places = []
        for training in report.evaluated:
            places += [f"{training.label} in {engine}" for engine in training.results]
        columns = ", ".join(map(short_name, report.filmed))
        console.print(
            f"film: {options['film']}\n      from the top: {', '.join(places)}; from the left: {columns}"
        )
    console.print(f"page: {report.page}")


COMMAND = verb(verbs.make_report, _show)
