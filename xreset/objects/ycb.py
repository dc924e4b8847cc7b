"""Published facts of the YCB object set (Calli et al. 2015, "Benchmarking in Manipulation Research") that DexYCB
uses, from ``ycb.toml``."""

from __future__ import annotations

from pathlib import Path

from xreset.errors import ObjectError
from xreset.files.storage import read_toml

_FACTS = read_toml(Path(__file__).with_name("ycb.toml"), error=ObjectError)

MASSES: dict[str, float] = {name: facts["mass"] for name, facts in _FACTS.items()}
"""Official name -> mass [kg], in the order of DexYCB's object ids: the first has id 1."""

ALIAS_OF: dict[str, str] = {
    name: facts["alias"] for name, facts in _FACTS.items() if "alias" in facts
}
"""Official name -> the paper's name."""

NAME_OF_ID = dict(enumerate(MASSES, start=1))
"""DexYCB's object id -> official name."""
