"""The physical properties that may cost a skill: how each is measured, compared, and changed in an engine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

from xreset.eval.engines.measure import Measured
from xreset.eval.engines.perturb import Alteration, contact_dial, no_contact_dial
from xreset.spec import SceneSpec

Change = Alteration | str
"""How an engine is changed, or why it cannot be."""


@dataclass(frozen=True)
class Property:
    """One property."""

    name: str
    field: str
    """Where it is in :class:`Measured`, and in :class:`Alteration` unless ``towards`` says otherwise."""
    resolution: float
    """Differences below this are not told apart: a share of the larger value, for ``absolute`` a number in the measured unit."""
    what_if: tuple[Alteration, ...] = ()
    """Changes of a usual size, to see how much the skill depends on the property; none where another property has them."""
    _: KW_ONLY
    unit: str = ""
    scale: float = 1.0
    """Factor from the measured number to the unit."""
    absolute: bool = False
    towards: Callable[[float, float, str, SceneSpec], Change] | None = None
    """From the values in A and B, A's name and the scene to the change; None: the ratio B / A as the factor ``field``."""
    at_most: str = ""
    """Why the change that there is goes farther than B does, so that its cost is a bound; empty: it does not."""

    def value(self, measured: Measured) -> float:
        """Its value in an engine; NaN if it could not be measured."""
        return getattr(measured, self.field)

    def same(self, a: Measured, b: Measured) -> bool:
        """Whether two engines cannot be told apart in it."""
        x, y = self.value(a), self.value(b)
        return abs(x - y) < self.resolution * (1.0 if self.absolute else max(abs(x), abs(y)))

    def change(self, a: Measured, b: Measured, engine: str, scene: SceneSpec) -> Change:
        """The change of A that gives it B's value, or why there is none."""
        x, y = self.value(a), self.value(b)
        if not (math.isfinite(x) and math.isfinite(y)):
            return "could not be measured in " + " and ".join(
                w for w, v in (("A", x), ("B", y)) if not math.isfinite(v)
            )
        if self.same(a, b):
            return "the same in both, as far as is measured"
        if self.towards is not None:
            return self.towards(x, y, engine, scene)
        if not (x > 0 and y > 0):
            return "is not positive in both, so there is no factor from one to the other"
        return Alteration(**{self.field: y / x})  # pyright: ignore[reportArgumentType]


def _timestep(a: float, b: float, engine: str, scene: SceneSpec) -> Change:
    """Another number of physics steps per control step; contacts keep their time constant where it is a dial in timesteps."""
    substeps = max(1, round(scene.substeps * a / b))
    if substeps == scene.substeps:
        return f"with {scene.substeps} physics steps per control step, no other timestep comes nearer"
    factor = scene.substeps / substeps
    dial = contact_dial(engine)
    return Alteration(timestep=factor, contact_time=max(dial.smallest, 1.0 / factor) if dial else 1.0)


def _contact_give(a: float, b: float, engine: str, scene: SceneSpec) -> Change:
    """Under a constant force a soft contact gives with the square of its time constant.

    MuJoCo's impedance grows with depth, which makes it up to a fifth less.
    """
    dial = contact_dial(engine)
    if dial is None:
        return no_contact_dial(engine)
    factor = math.sqrt(max(b, 0.0) / a) if a > 0 else math.inf
    if factor < dial.smallest:
        return f"not changeable in {engine} towards stiffer: {dial.limit}"
    if not math.isfinite(factor):
        return f"not changeable in {engine}: its contacts do not give at all"
    return Alteration(contact_time=factor)


def _torsion(a: float, b: float, engine: str, scene: SceneSpec) -> Change:
    """Unlike other factors this one may be 0."""
    if a <= 0:
        return f"not changeable in {engine}: it has none, and nothing times any factor is nothing"
    return Alteration(torsional_friction=max(b, 0.0) / a)


def _patch_torsion(a: float, b: float, engine: str, scene: SceneSpec) -> Change:
    if b > a:
        return f"not changeable in {engine}: what it leaves out beside a second point, no friction of the scene brings back"
    return Alteration(torsional_friction=max(b, 0.0) / a)


def _delay(a: float, b: float, engine: str, scene: SceneSpec) -> Change:
    if b < a:
        return f"not changeable in {engine}: targets that come late cannot be made to come earlier"
    return Alteration(delay=round(b - a))


_FARTHER = "changed in every contact, where the engines differ only beside a second point"
PROPERTIES = (
    Property("tip friction", "tip_friction", 0.03, (Alteration(tip_friction=0.8),)),
    Property("link friction", "link_friction", 0.03, (Alteration(link_friction=0.8),)),
    Property("table friction", "table_friction", 0.03, (Alteration(table_friction=0.8),)),
    Property(
        "torsional friction", "torsional_friction", 5e-5, (Alteration(torsional_friction=0.0), Alteration(torsional_friction=2.0)),
        unit="mm", scale=1e3, absolute=True, towards=_torsion,
    ),
    Property("patch torsional friction", "patch_torsional_friction", 0.05, absolute=True, towards=_patch_torsion, at_most=_FARTHER),
    Property("object mass", "mass", 0.005, (Alteration(mass=1.2),)),
    Property("object inertia", "inertia", 0.02, (Alteration(inertia=1.2),)),
    Property("arm stiffness", "arm_stiffness", 0.02, (Alteration(arm_stiffness=0.8),)),
    Property("arm damping", "arm_damping", 0.02, (Alteration(arm_damping=0.8),)),
    Property("hand stiffness", "hand_stiffness", 0.03, (Alteration(hand_stiffness=0.8),)),
    Property("hand damping", "hand_damping", 0.02, (Alteration(hand_damping=0.8),)),
    Property("timestep", "timestep", 0.05, (Alteration(timestep=0.5),), unit="ms", scale=1e3, towards=_timestep),
    Property(
        "contact softness", "contact_give", 2e-5, (Alteration(contact_time=1.5),),
        unit="mm", scale=1e3, absolute=True, towards=_contact_give,
    ),
    Property("latency", "delay", 0.5, (Alteration(delay=1),), unit="control steps", absolute=True, towards=_delay),
)  # fmt: skip
"""In the order of the table. Contacts and timestep aside, every engine can be changed in all of them, for they are in the scene."""
