"""What an object is made of, as ``NAME.toml`` beside its mesh: ``mass`` [kg] or ``density`` [kg/m^3], and ``friction``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from xreset.checks import from_dict
from xreset.errors import ObjectError
from xreset.files import atomic_write, read_toml
from xreset.text import shown

_RANGES = {"mass": (1e-4, 50.0), "density": (1.0, 25_000.0), "friction": (0.05, 3.0)}
"""[kg], [kg/m^3] (osmium has 22,600), coefficient."""


@dataclass(frozen=True, kw_only=True)
class Properties:
    """None: not known."""

    mass: float | None = None
    """[kg]"""
    density: float | None = None
    """[kg/m^3], of the mesh's volume."""
    friction: float | None = None
    """Coefficient of its material; see :attr:`xreset.spec.ObjectSpec.friction`."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} is {shown(value)}, expected a number from {low:g} to {high:g}")
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density are both given; one follows from the other")

    def write(self, path: Path) -> None:
        """Write those that are known; no file if none is."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        if known:
            with atomic_write(path, "w") as file:
                file.writelines(f"{name} = {float(value)!r}\n" for name, value in known.items())


def properties_of(mesh: Path) -> Properties:
    """Of the file beside a mesh; nothing known if there is none.

    Raises:
        ObjectError: it is not what it should be.
    """
    path = mesh.with_suffix(".toml")
    if not path.is_file():
        return Properties()
    return from_dict(Properties, read_toml(path, error=ObjectError), str(path))
