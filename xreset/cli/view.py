"""``xreset view``."""

from xreset.cli._verbs import verb
from xreset.pictures import verbs

COMMAND = verb(verbs.view)
