"""The demonstrations that a study's runs are trained with: some objects of its data, and what was made of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from xreset.demos.archive import Demos, read_demos, write_demos
from xreset.demos.synth import synthesize
from xreset.errors import RunError
from xreset.eval.study.file import Data
from xreset.files import file_hash, read_json, write_json
from xreset.text import short_name, shown

SUBSET_SCHEMA = "xreset-subset/1"


@dataclass(frozen=True, kw_only=True)
class Subset:
    """Demonstrations of some objects of a study's data."""

    name: str
    """Of the data."""
    data: Data
    given: Path
    """Folder that the data's files are relative to."""
    out: Path
    objects: tuple[str, ...]
    """Empty: all."""
    per_object: int | None

    @property
    def folder(self) -> Path:
        """Named after what it holds."""
        parts = [self.name, "+".join(short_name(name, "_") for name in self.objects), str(self.per_object or "")]
        return self.out / "data" / "-".join(filter(None, parts))

    @property
    def demos(self) -> Path:
        """The archive."""
        return self.folder / "demos.npz"

    @property
    def meshes(self) -> list[str]:
        """``--objects``."""
        return ["--objects", str(self.given / self.data.meshes)] if self.data.meshes else []

    @cached_property
    def definition(self) -> dict[str, Any]:
        """All that its files depend on."""
        source = (
            {"demos": file_hash(self.given / self.data.demos)}
            if self.data.demos
            else {"synthetic_per_object": self.data.synthetic_per_object, "synthetic_seed": self.data.synthetic_seed}
        )
        options = {name: list(getattr(self.data, name)) for name in ("retarget", "resets")}
        return (
            source
            | options
            | {"objects": list(self.objects), "per_object": self.per_object, "meshes": self.data.meshes}
        )

    def check(self) -> None:
        """Refuse files that were made of something else."""
        file = self.folder / "subset.json"
        if not file.is_file():
            return
        made = read_json(file, SUBSET_SCHEMA)
        names = sorted({*made, *self.definition})
        there, wanted = ({k: of.get(k) for k in names} for of in (made, self.definition))
        refuse_other(f"{self.folder} was made otherwise", "data", there, wanted)

    def make(self) -> None:
        """Write the archive, if it is not there."""
        if self.demos.is_file() and (self.folder / "subset.json").is_file():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        demos = source_demos(self.data, self.given, self.objects)
        chosen = demos.select(objects=self.objects or None, max_per_object=self.per_object)
        write_demos(self.demos, chosen, config=self.definition)
        write_json(self.folder / "subset.json", {"schema": SUBSET_SCHEMA} | self.definition)


def source_demos(data: Data, given: Path, objects: tuple[str, ...]) -> Demos:
    """All demonstrations of the data, or the synthetic ones of some objects."""
    if data.demos:
        return read_demos(given / data.demos)
    return synthesize(objects or None, data.synthetic_per_object, data.synthetic_seed)


def refuse_other(problem: str, what: str, there: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> None:
    """Refuse what is there under a name of the study, if it is not what the study wants."""
    for name, here in wanted.items():
        if isinstance(here, dict) and isinstance(there[name], dict):
            refuse_other(problem, what, there[name], here, f"{prefix}{name}.")
        elif there[name] != here:
            raise RunError(
                f"{problem}: {prefix}{name} is {shown(there[name])} there and {shown(here)} in the study. "
                f"Nothing was changed; give the {what} another name, or choose another --out."
            )
