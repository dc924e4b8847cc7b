"""``xreset resets``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.table import Table

from xreset.accounts import accounts_path, described, write_accounts
from xreset.cli._terminal import Console, Progress
from xreset.files import file_hash
from xreset.resets.config import ClosingConfig, FilterConfig, SqueezeConfig

if TYPE_CHECKING:
    from xreset.resets import bank as banks
    from xreset.retarget import file


def resets(
    retargeted: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    robot: str | None = None,
    objects: Path | None = None,
    num_envs: int = 64,
    device: str = "cpu",
    limits: Annotated[FilterConfig, tyro.conf.arg(name="filter")] = FilterConfig(),
    closing: ClosingConfig = ClosingConfig(),
    squeeze: SqueezeConfig = SqueezeConfig(),
    settle: bool = False,
) -> None:
    """Try retargeted states in physics and keep the stable ones.

    Args:
        retargeted: File made by `xreset retarget`.
        out: Reset bank to write.
        backend: Physics engine to try the states in; give it again to keep only states that are stable in all of them.
            Default: mujoco.
        robot: Folder of the robot, if it is not one that is known by name.
        objects: Folder of real meshes; default: the built-in stand-ins.
        num_envs: Worlds at a time.
        device: Where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        limits: Time and speeds by which states are judged.
        closing: States between frames where the hand closes in.
        squeeze: Targets of states after contact that press.
        settle: Let objects come to rest (in the first engine) before episodes begin at home. Default: the recorded
            poses, as in the paper, from which one object in eight tips or rolls.
    """
    from xreset import description
    from xreset.objects import catalogue
    from xreset.resets import bank as banks
    from xreset.resets import filter as trying
    from xreset.resets import settle as settling
    from xreset.retarget import file

    backends = list(dict.fromkeys(backend)) or ["mujoco"]
    console = Console()
    data = file.read_retargeted(retargeted)
    spec = description.load_robot(robot or data.robot)
    banks.check_retargeted(retargeted, data, spec)
    loaded = catalogue.load_objects(sorted({*map(str, data.object_name)}), objects)
    with Progress(console) as bar:
        bank = trying.make_bank(
            data, spec, loaded, backends, num_envs=num_envs, device=device, limits=limits, closing=closing,
            squeeze=squeeze,
            progress=bar.count(f"states in {', '.join(backends)}"),
        )  # fmt: skip
        at_rest = None
        if settle:
            bank, at_rest = settling.settle_starts(
                bank, spec, loaded, backends[0], num_envs=num_envs, device=device,
                progress=bar.count("start poses come to rest"),
            )  # fmt: skip
    config = {
        "backends": backends,
        "num_envs": num_envs,
        "filter": asdict(limits),
        "closing": asdict(closing),
        "squeeze": asdict(squeeze),
        "settle": settle,
    }
    banks.write_bank(out, bank, config=config, inputs={"retargeted": file_hash(retargeted)})
    write_accounts(
        accounts_path(out),
        of="states tried in physics",
        rows=bank.accounts(),
        pressing=bank.num_pressing,
    )

    if at_rest is not None:
        console.print(
            f"{at_rest.sum()} of {len(at_rest)} objects came to rest at the start; the others start as recorded"
        )
    console.print(_accepted(data, bank, f"{spec.name}: states stable in {', '.join(backends)}"))
    if squeeze.force > 0:
        console.print(
            f"{bank.num_pressing} of {int(bank.post_contact.sum())} states after contact press with {squeeze.force:g} N"
        )
    tried = bank.num_states + len(bank.rejected_reason)
    console.print(f"{bank.num_states} states of {tried} kept in {out}; counts in {accounts_path(out)}")


def _accepted(data: file.Retargeted, bank: banks.ResetBank, title: str) -> Table:
    """How many states of each object and phase are kept."""
    annotated = {(row.object_name, row.phase): row.without("not annotated").total for row in data.accounts()}
    table = Table(
        "object",
        "phase",
        "annotated frames",
        "valid: tried",
        "accepted",
        "of annotated",
        "rejected because of",
        title=title,
    )
    for row in bank.accounts():
        frames = annotated.get((row.object_name, row.phase), 0)
        table.add_row(
            row.object_name,
            row.phase,
            str(frames),
            str(row.total),
            f"{row.kept} ({row.share:.0%})" if row.total else "0",
            f"{row.kept / frames:.0%}" if frames else "-",
            described(row.lost),
        )
    return table


COMMAND = resets
