"""From folders to the picture and the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from xreset import __version__
from xreset.errors import RunError
from xreset.eval.report import fairness, lifting
from xreset.eval.report import tables as table
from xreset.eval.report.compare_plots import write_picture
from xreset.eval.report.groups import Group, grouped, singles
from xreset.eval.report.progress import X
from xreset.eval.report.score import scores
from xreset.eval.report.trainings import Training, read_trainings
from xreset.files import atomic_write

CURVES = ("task/success", "task/success_from_home")
"""What is drawn if nothing else is asked for."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What was made."""

    picture: Path
    page: Path
    groups: tuple[Group, ...]
    results: table.Rows
    """Empty if nothing was evaluated."""
    lifted: table.Rows
    """When each training passed 1, 10 and 50 % success from home; empty if that is not known of any."""
    different: table.Rows
    """Fields in which the trainings are not equal; without a column if none has a configuration or curves."""
    notes: tuple[str, ...]
    """What is unfair, missing or doubtful."""
    captions: tuple[str, ...]
    """What the figures are."""


def compare(runs: Sequence[str], out: Path, *, x: X = "minutes", curves: Sequence[str] = (), apart: bool = False) -> Comparison:
    """Write ``compare.png`` and ``compare.md``.

    Args:
        runs: folders, as ``FOLDER`` or ``LABEL=FOLDER``.
        out: folder for the files.
        x: horizontal axis of the learning curves.
        curves: names of curves as in TensorBoard; default: :data:`CURVES`.
        apart: show trainings that differ in their seed only one by one, not as one.

    Raises:
        RunError: there is nothing to compare, labels are not unique, or there is no such curve.
        FileFormatError: a file is damaged.
        XResetError: the files cannot be written, or a package for curves or plots is missing.
    """
    trainings = read_trainings(runs)
    groups, notes = (singles(trainings), ()) if apart else grouped(trainings)
    tags = choose_curves(trainings, curves)
    found = scores(groups)
    notes = (
        *notes,
        *fairness.notes(trainings),
        *fairness.begun(trainings),
        *fairness.health(found),
        *fairness.missing(groups, tags),
        *lifting.notes(groups),
    )
    made = Comparison(
        picture=out / "compare.png",
        page=out / "compare.md",
        groups=groups,
        results=table.results(groups, found),
        lifted=table.lifted(groups, x),
        different=table.different(groups),
        notes=notes,
        captions=(*_captions(trainings, groups), *([table.LIFTED] if any(map(lifting.lift_of, trainings)) else [])),
    )
    content = page(made)
    write_picture(made.picture, groups, tags, found, x)
    with atomic_write(made.page) as file:
        file.write(content.encode())
    return made


def choose_curves(trainings: Sequence[Training], wanted: Sequence[str]) -> tuple[str, ...]:
    """The curves to draw: those that are wanted, without repetition; none if no training has any.

    Raises:
        RunError: no training has one of them.
    """
    known = sorted({tag for t in trainings for tag in t.scalars})
    if not known and not wanted:
        return ()
    chosen = tuple(dict.fromkeys(wanted or CURVES))
    if unknown := [tag for tag in chosen if tag not in known]:
        there = f"there are {', '.join(known)}" if known else "none of these runs has learning curves"
        raise RunError(f"there is no curve {', '.join(unknown)}; {there}. Choose with --curve.")
    return chosen


def page(made: Comparison) -> str:
    """``compare.md``."""
    labels = ", ".join(group.label for group in made.groups)
    parts = [f"# Comparison: {table.escape(labels)}\n", f"![Learning curves and task progress]({made.picture.name})\n"]
    parts += [f"> **Note:** {table.escape(note)}\n" for note in made.notes]
    if made.results.body:
        parts += ["## Evaluation\n", table.markdown(made.results)]
    if made.lifted.body:
        parts += ["## First success from home\n", table.markdown(made.lifted)]
    parts += [f"{table.escape(caption)}\n" for caption in made.captions]
    if len(made.different.head) > 1:
        parts += ["## What differs between the trainings\n"]
        parts += [table.markdown(made.different)] if made.different.body else ["Nothing.\n"]
    parts.append(f"xreset {__version__}\n")
    return "\n".join(parts)


def _captions(trainings: Sequence[Training], groups: Sequence[Group]) -> tuple[str, ...]:
    evaluated = [next(iter(t.summaries.values())) for t in trainings if t.summaries]
    captions = []
    if evaluated:
        numbers = sorted({s.episodes for s in evaluated})
        count = str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
        captions.append(
            f"From home at full gravity, {count} episodes of each training in each engine. "
            "The 95 % interval is a bootstrap over demonstrations."
        )
    for group in groups:
        if len(group.members) > 1:
            names = ", ".join(m.label for m in group.members)
            text = f"{group.label} is {len(group.members)} trainings that differ in the seed only ({names}): curves are their mean"
            text += ", bands go from the lowest to the highest"
            if sum(bool(m.summaries) for m in group.members) > 1:
                text += ", and the interval is a bootstrap over trainings and demonstrations, which is too narrow for few trainings"
            captions.append(text + ".")
    return tuple(captions)
