"""Which physical difference between two engines costs a skill: one property at a time, changed towards the other engine's value."""

from xreset.eval.attribute.alteration import Alteration, AlteredBackend, altered_engine
from xreset.eval.attribute.experiment import Attribution, Row, attribute
from xreset.eval.attribute.probes import Measured, measure
from xreset.eval.attribute.properties import PROPERTIES, Property

__all__ = [
    "PROPERTIES",
    "Alteration",
    "AlteredBackend",
    "Attribution",
    "Measured",
    "Property",
    "Row",
    "altered_engine",
    "attribute",
    "measure",
]
