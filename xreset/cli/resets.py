"""``xreset resets``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import arg

from xreset.cli._common import Device, Meshes, Several, Source, show_accounts
from xreset.cli._terminal import Progress, console, show_notes
from xreset.files.storage import file_hash
from xreset.resets.config import ClosingConfig, FilterConfig, SqueezeConfig, TransferConfig


def resets(
    retargeted: Source,
    *,
    out: Path,
    engine: Several = (),
    robot: str | None = None,
    meshes: Meshes = None,
    num_envs: int = 64,
    device: Device = "cpu",
    limits: Annotated[FilterConfig, arg(name="filter")] = FilterConfig(),
    closing: ClosingConfig = ClosingConfig(),
    squeeze: SqueezeConfig = SqueezeConfig(),
    transfer: TransferConfig = TransferConfig(),
    settle: bool = False,
) -> None:
    """Test retargeted states in physics and keep the stable ones.

    Args:
        retargeted: File made by `xreset retarget`.
        out: Reset bank to write.
        engine: Physics engine to test the states in; give it again to keep only states that are stable in all engines.
            Default: mujoco.
        robot: Folder of the robot, if it is not known by name.
        num_envs: Worlds at a time.
        limits: Duration of the test, and the largest speeds of a stable state.
        closing: Extra states between frames in which the hand closes in on the object.
        squeeze: How hard fingers press in states after contact, and which fingers.
        transfer: Extra states at poses of each demonstration, in grasps of other demonstrations of the same object
            that hold its full weight in every engine. There are none if no finger presses.
        settle: Let objects come to rest (in the first engine) before episodes begin at home. Default: the recorded
            poses, as in the paper, from which one object in eleven turns by more than 10 degrees.
    """
    from xreset.files.records import stated_doubts
    from xreset.geometry.description import load_robot
    from xreset.objects.catalogue import load_objects
    from xreset.resets.bank import write_bank
    from xreset.resets.filter import make_bank
    from xreset.resets.settle import settle_starts
    from xreset.resets.transfer import add_transfers
    from xreset.retarget.file import check_retargeted, object_sources, read_retargeted

    engines = list(dict.fromkeys(engine)) or ["mujoco"]
    motion = read_retargeted(retargeted)
    stated = object_sources(retargeted)
    doubts = stated_doubts(retargeted)
    show_notes(doubts)
    made_from = {"retargeted": file_hash(retargeted)}
    spec = load_robot(robot or motion.robot)
    check_retargeted(retargeted, motion, spec)
    loaded = load_objects(motion.object_names, meshes)
    scene = (spec, loaded)
    if changed := [o.name for o in loaded if stated.get(o.name, o.source) != o.source]:
        warning = f"{retargeted} was made with other meshes of {', '.join(changed)}"
        show_notes([f"{warning}. Give the same --meshes folder."])
    where = {"num_envs": num_envs, "device": device}
    title = f"states stable in {', '.join(engines)}"
    with Progress() as bar:
        bank = make_bank(
            motion,
            *scene,
            engines,
            limits=limits,
            closing=closing,
            squeeze=squeeze,
            transfer=None,
            progress=bar.count(title),
            **where,
        )
        if transfer.per_pose and squeeze.presses:
            count = bar.count("grasps of other demonstrations")
            bank = add_transfers(bank, motion, *scene, transfer, progress=count, **where)
        if settle:
            count = bar.count("start poses come to rest")
            bank, at_rest = settle_starts(bank, *scene, engines[0], progress=count, **where)
            moved = f"{at_rest.sum()} of {len(at_rest)} objects came to rest at the start"
            console.print(f"{moved}; the others start as recorded")
    config = {
        "engines": engines,
        "num_envs": num_envs,
        "filter": asdict(limits),
        "closing": asdict(closing),
        "squeeze": asdict(squeeze),
        "transfer": asdict(transfer),
        "settle": settle,
        "doubts": doubts,
    }
    write_bank(out, bank, config=config, inputs=made_from)
    accounts = bank.accounts()
    show_accounts(accounts, f"{bank.robot}: {title}")
    if squeeze.presses:
        force = f"{squeeze.force:g} N"
        if squeeze.weight:
            force += f" and {squeeze.weight:g} times the object's weight"
        pressing = f"{bank.num_pressing} of {bank.post_contact.sum()} states after contact"
        console.print(f"{pressing} press with {force}")
    share = accounts[-1].kept / max(motion.annotated.sum(), 1)
    console.print(f"{share:.0%} of the annotated frames are kept")
    own = int(bank.own_grasp.sum())
    console.print(f"{own} states of {own + len(bank.rejected_reason)} kept in {out}")
    if transfer.per_pose:
        where_added = np.unique(bank.sequence_index[~bank.own_grasp])
        console.print(
            f"{bank.num_states - own} states in grasps of other demonstrations added, to {len(where_added)} of "
            f"{len(bank.sequence_name)} demonstrations"
        )


COMMAND = resets
