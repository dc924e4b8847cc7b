"""Functions that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from xreset.cli._terminal import console, show_table
from xreset.physics.plugins import backend_names, backend_status
from xreset.retarget.accounts import Account, described


def usable_engines() -> list[str]:
    """Return the names of the engines that can be used here, and print why the others cannot."""
    statuses = [backend_status(name) for name in backend_names()]
    for status in statuses:
        if status.reason is not None:
            console.print(f"without {status.name}: {status.reason}")
    return [status.name for status in statuses if status.reason is None]


def in_all_engines(arguments: dict[str, Any]) -> None:
    """Let a command without engines use all that can be used here."""
    arguments["engine"] = arguments.get("engine") or usable_engines()


def in_quick_engines(arguments: dict[str, Any]) -> None:
    """Let a command without engines use all that can be used here and are not slow on the device."""
    arguments["engine"] = quick_engines(arguments.get("engine", ()), arguments["device"])


def quick_engines(names: Sequence[str], device: str) -> list[str]:
    """Return names of engines, each once; without any, those that can be used here and are not slow on the device."""
    from xreset.eval.rollout import chosen_engines

    engines = chosen_engines(names or usable_engines(), device)
    return [each.name for each in engines if names or not each.slow]


def show_accounts(rows: Sequence[Account], title: str) -> None:
    """Print how many frames or states of each object and phase are kept, and why the others are rejected."""
    table = [("object", "phase", "frames", "kept", "rejected")]
    for row in rows:
        kept = f"{row.kept} ({row.kept / row.total:.0%})" if row.total else "0"
        table.append((row.object_name, row.phase, str(row.total), kept, described(row.lost)))
    show_table(table, title=title)


def depth_text(depth: np.ndarray, what: str) -> str:
    """Return how deep the robot is in the object, for depths [N] of frames or states [m] and their name."""
    deep = np.mean(depth > 0.002)
    return f"in {what} the robot is at most {1e3 * depth.max():.1f} mm deep in the object ({deep:.1%} over 2 mm)"


def write_next_to_policy(arguments: dict[str, Any], name: str | None = None) -> None:
    """Let results go into the policy's own folder, or into one of another name beside it, if ``out`` is None."""
    if arguments["out"] is None:
        from xreset.eval.policy_spec import load_policy

        policy = load_policy(arguments["policy"], robot=arguments["robot"])
        arguments["policy"] = policy
        arguments["out"] = policy.folder.with_name(name) if name else policy.folder
