"""``xreset export``: lerobot, npz, deploy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from xreset import runtime
from xreset.cli._common import Name, Several
from xreset.cli._terminal import Console, Progress
from xreset.errors import RunError
from xreset.eval.export import deploy as deployment
from xreset.eval.export import lerobot as dataset
from xreset.eval.export import recorded

Folders = Annotated[tuple[Path, ...], tyro.conf.Positional]


def lerobot(
    folders: Folders,
    *,
    out: Path,
    backend: Several = (),
    robot: str | None = None,
    objects: Path | None = None,
    task: str | None = None,
    video: bool = True,
    size: tuple[int, int] = (320, 240),
    camera: Several = (),
) -> None:
    """Write recorded evaluation episodes as a LeRobot data set (v3.0): the first episode of each demonstration and
    engine.

    Args:
        folders: Run folders, or folders that xreset eval wrote into.
        out: Folder to write; must not exist.
        backend: Only episodes of this engine; give it again for more. Default: all.
        robot: Name or folder of the robot; default: as the results name it.
        objects: Folder of meshes; default: as the results name it.
        task: The task in words; {object} is replaced by the object's name.
        video: Draw a film of each episode.
        size: Width and height of the films, pixels.
        camera: Also draw films of this depth camera: front, side or wrist; give it again for more.
    """
    recording = _recording(folders, backend, robot, objects, task)
    with Progress(Console(stderr=True)) as bar:
        progress = bar.count("writing episodes")
        dataset.write_lerobot(out, recording, video=video, size=size, cameras=camera, progress=progress)
    _say(recording, out)


def npz(
    folders: Folders, *, out: Path, backend: Several = (), robot: str | None = None, task: str | None = None
) -> None:
    """Write recorded evaluation episodes as plain arrays in one npz file (docs/rollouts.md has the schema).

    Args:
        folders: Run folders, or folders that xreset eval wrote into.
        out: File to write.
        backend: Only episodes of this engine; give it again for more. Default: all.
        robot: Name or folder of the robot; default: as the results name it.
        task: The task in words; {object} is replaced by the object's name.
    """
    recording = _recording(folders, backend, robot, None, task)
    recorded.write_arrays(out, recording)
    _say(recording, out)


def deploy(
    policy: Name, *, out: Path, robot: str | None = None, objects: Path | None = None, object: Several = ()
) -> None:
    """Write a policy for a robot: the network, a contract that says what goes in and out, and a runtime.

    The runtime needs Python, numpy and onnxruntime (docs/live.md).

    Args:
        policy: Run folder, exported policy (.onnx), or name of a policy that ships with xreset (xreset policies list).
        out: Folder to write; must not exist.
        robot: Name or folder of the robot; default: the policy's.
        objects: Folder of meshes; default: that of the training, else the stand-ins.
        object: Object whose points the contract lists; give it again for more. Default: the objects of the training.
    """
    spec = deployment.export_deploy(policy, out, robot=robot, objects=objects, only=object)
    contract = runtime.read_contract(out)
    named = []
    for name, entry in contract["objects"].items():
        named.append(f"{name} ({'stand-in' if entry['source'] == 'stand-in' else 'mesh'})")
    console = Console()
    console.print(
        f"{out}: {spec.name} for {contract['robot']}, {len(contract['joints'])} joints at {contract['rate']:g} Hz"
    )
    console.print(f"objects: {', '.join(named)}")
    console.print(f"Try it: cd {out} && python -m runtime")


def _recording(
    folders: tuple[Path, ...], backends: tuple[str, ...], robot: str | None, objects: Path | None, task: str | None
) -> recorded.Recording:
    if not folders:
        raise RunError("Nothing to export. Give a run folder, or a folder that xreset eval wrote into.")
    return recorded.read_recorded(folders, backends=backends, robot=robot, objects=objects, task=task or recorded.TASK)


def _say(recording: recorded.Recording, out: Path) -> None:
    engines = ", ".join(recording.episodes["engine"].unique())
    Console().print(
        f"{out}: {len(recording.episodes)} episodes of {recording.robot.name} in {engines},"
        f" {recording.offsets[-1]} frames at {recording.fps:g} per second"
    )


COMMAND = {"lerobot": lerobot, "npz": npz, "deploy": deploy}
