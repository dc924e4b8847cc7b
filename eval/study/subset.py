"""Demonstrations of some objects of a study's data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from xreset.demos.archive import read_demos, write_demos
from xreset.demos.synth import synthesize
from xreset.errors import RunError
from xreset.eval.report.read import flat
from xreset.eval.study.file import Data
from xreset.files import file_hash, read_json, write_json
from xreset.text import short_name, shown

SUBSET_SCHEMA = "xreset-subset/1"


@dataclass(frozen=True, kw_only=True)
class Subset:
    """Demonstrations of some objects of a study's data."""

    name: str
    """Name of the data."""
    data: Data
    given: Path
    """Folder that the data's files are relative to."""
    out: Path
    objects: tuple[str, ...]
    """Empty: all objects."""
    per_object: int | None

    @property
    def folder(self) -> Path:
        """Folder of the subset, named after its content."""
        objects = "+".join(short_name(name, "_") for name in self.objects).replace("/", "_")
        return (
            self.out
            / "data"
            / "-".join(filter(None, [self.name, objects, str(self.per_object or "")]))
        )

    @property
    def demos(self) -> Path:
        """The archive."""
        return self.folder / "demos.npz"

    @property
    def mesh_options(self) -> list[str]:
        """The option ``--objects`` of commands, if there are meshes."""
        return ["--objects", str(self.given / self.data.meshes)] if self.data.meshes else []

    @cached_property
    def definition(self) -> dict[str, Any]:
        """Everything that the subset's files depend on."""
        data = self.data
        if data.demos:
            source: dict[str, Any] = {"demos": file_hash(self.given / data.demos)}
        else:
            source = {
                "synthetic_per_object": data.synthetic_per_object,
                "synthetic_seed": data.synthetic_seed,
            }
        return source | {
            "retarget": list(data.retarget),
            "resets": list(data.resets),
            "objects": list(self.objects),
            "per_object": self.per_object,
            "meshes": data.meshes,
        }

    def check(self) -> None:
        """Refuse files of another definition."""
        file = self.folder / "subset.json"
        if file.is_file():
            made = read_json(file, SUBSET_SCHEMA)
            refuse_other(f"{self.folder} was made otherwise", "data", made, self.definition)

    def make(self) -> None:
        """Write the archive, unless it exists."""
        file = self.folder / "subset.json"
        if self.demos.is_file() and file.is_file():
            return
        if self.data.demos:
            demos = read_demos(self.given / self.data.demos)
        else:
            demos = synthesize(
                self.objects or None, self.data.synthetic_per_object, self.data.synthetic_seed
            )
        chosen = demos.select(objects=self.objects or None, max_per_object=self.per_object)
        write_demos(self.demos, chosen, config=self.definition)
        write_json(file, {"schema": SUBSET_SCHEMA} | self.definition)


def refuse_other(problem: str, what: str, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Refuse what has the study's name if it is not what the study describes.

    Raises:
        RunError: an entry differs; the message names it.
    """
    old = dict(flat(found))
    new = dict(flat(wanted))
    for name in sorted({*old, *new}):
        if old.get(name) != new.get(name):
            raise RunError(
                f"{problem}: {name} is {shown(old.get(name))} there and {shown(new.get(name))} in the study. "
                f"Nothing was changed; give the {what} another name, or choose another --out."
            )
