"""``xreset resets``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.cli._common import depth_text, show_accounts
from xreset.cli._terminal import console
from xreset.cli._verbs import REQUIRED, verb
from xreset.files.text import quantity
from xreset.resets import verbs

if TYPE_CHECKING:
    from xreset.resets.bank import ResetBank


def _show(bank: ResetBank, options: Mapping[str, Any]) -> None:
    title = f"{bank.robot}: states stable in {', '.join(bank.engines)}"
    show_accounts(bank.accounts(), title)
    own = int(bank.own_grasp.sum())
    tried = own + len(bank.rejected_reason)
    kept = f"{quantity(own, 'state')} of {tried} kept in {options['out']}"
    if bank.frame_part is not None:
        between = np.count_nonzero(bank.own_grasp & (bank.frame_part > 0))
        kept += f", {between} of them closing states between frames"
    console.print(kept)
    added = bank.sequence_index[~bank.own_grasp]
    if len(added):
        console.print(
            f"{quantity(len(added), 'state')} in grasps of other demonstrations added, to {len(np.unique(added))} of "
            f"{quantity(len(bank.sequence_name), 'demonstration')}"
        )
    if bank.num_pressing:
        console.print(
            f"{bank.num_pressing} of {bank.post_contact.sum()} states after contact press"
        )
    if bank.object_depth is not None and bank.num_states:
        console.print(depth_text(bank.object_depth, "all states"))


COMMAND = verb(verbs.make_bank, _show, out=REQUIRED)
