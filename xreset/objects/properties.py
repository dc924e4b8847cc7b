"""Properties of an object, as ``NAME.toml`` in its folder of objects: ``mass`` [kg] or ``density`` [kg/m^3],
``friction``, and ``tolerance`` [m]."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from xreset.errors import ObjectError, WrongValueError
from xreset.files.checks import Checked, Rule, from_dict, frozen
from xreset.files.storage import read_toml

MASSES = (1e-4, 50.0)
"""Least and largest mass of an object [kg]."""
DENSITIES = (2.0, 25_000.0)
"""Least and largest density of an object [kg/m^3]: an empty balloon is above, osmium with 22,600 below."""


def _within(low: float, high: float) -> Rule:
    return Rule(f"a number from {low:g} to {high:g}", lambda value: low <= value <= high)


@frozen
class Properties(Checked):
    """None: unknown."""

    mass: Annotated[float, _within(*MASSES)] | None = None
    """[kg]"""
    density: Annotated[float, _within(*DENSITIES)] | None = None
    """[kg/m^3], of the mesh's volume."""
    friction: Annotated[float, _within(0.05, 3.0)] | None = None
    """Coefficient of its material; see :attr:`xreset.spec.ObjectSpec.friction`."""
    tolerance: Annotated[float, _within(5e-4, 0.1)] | None = None
    """Largest deviation of the convex pieces from the surface [m]; None: a mesh near its convex hull is one piece."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mass is not None and self.density is not None:
            raise WrongValueError("mass and density are both given; one follows from the other")

    def to_toml(self) -> str:
        """Return the text of the file; empty if nothing is known."""
        return "".join(
            f"{name} = {float(value)!r}\n"
            for name, value in vars(self).items()
            if value is not None
        )


def properties_file(mesh: Path) -> Path:
    """Return the file with the properties of a mesh ``NAME.obj`` or, in YCB's layout, ``NAME/textured.obj``:
    ``NAME.toml``. A file next to the mesh comes first."""
    own = mesh.with_suffix(".toml")
    folder = mesh.absolute().parent
    if mesh.stem.startswith("textured") and not own.is_file():
        return folder.with_name(f"{folder.name}.toml")
    return own


def properties_of(mesh: Path) -> Properties:
    """Read the properties of a mesh; nothing is known without a file.

    Raises:
        ObjectError: the file is damaged, or a value is out of range.
    """
    path = properties_file(mesh)
    if not path.is_file():
        return Properties()
    return from_dict(Properties, read_toml(path, error=ObjectError), str(path))


def refuse_taken(mesh: Path, known: str) -> None:
    """Raise ``ObjectError`` if a folder has a mesh, or other properties of it than the known ones: a command that was
    killed between the two files can be repeated."""
    path = mesh.with_suffix(".toml")
    if mesh.exists() or (path.exists() and path.read_bytes() != known.encode()):
        raise ObjectError(
            f"{mesh} or its .toml is there already. Nothing was changed; choose another name or folder."
        )
