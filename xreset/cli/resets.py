"""``xreset resets``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import numpy as np
from tyro.conf import arg

from xreset.cli._common import Device, MotionMeshes, Several, Source, show_accounts
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console, show_notes
from xreset.files.checks import PositiveInt
from xreset.resets.config import ClosingConfig, FilterConfig, SqueezeConfig, TransferConfig


def resets(
    retargeted: Source,
    *,
    out: Output,
    engine: Several = (),
    robot: str | None = None,
    meshes: MotionMeshes = None,
    num_envs: PositiveInt = 64,
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
    from xreset.resets.bank import write_bank
    from xreset.resets.filter import make_bank
    from xreset.resets.inputs import load_inputs
    from xreset.resets.settle import settle_starts
    from xreset.resets.transfer import add_transfers

    engines = list(dict.fromkeys(engine)) or ["mujoco"]
    inputs = load_inputs(retargeted, robot=robot, meshes=meshes, accept=("motion",))
    motion = inputs.motion()
    doubts = stated_doubts(retargeted)
    show_notes(doubts)
    scene = (inputs.robot, inputs.objects)
    squeeze = squeeze.for_hand(len(inputs.robot.fingertips))
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
        "meshes": str(inputs.meshes) if inputs.meshes else None,
        "doubts": doubts,
    }
    write_bank(out, bank, config=config, inputs={"retargeted": str(inputs.hash)})
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
