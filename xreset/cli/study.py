"""``xreset study``."""

from xreset.cli._verbs import verb
from xreset.eval import verbs

COMMAND = verb(verbs.run_study)
