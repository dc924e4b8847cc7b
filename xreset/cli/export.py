"""``xreset export``: lerobot, npz, deploy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from xreset import runtime
from xreset.cli._common import Policy, Robot, Several, Sources, TrainedMeshes
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console

if TYPE_CHECKING:
    from xreset.eval.export import recorded


def lerobot(
    folders: Sources,
    *,
    out: Output,
    engine: Several = (),
    robot: Robot = None,
    meshes: Path | None = None,
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
        engine: Only episodes of this engine; give it again for more. Default: all.
        meshes: Folder of meshes; default: as the results name it.
        task: The task in words; {object} is replaced by the object's name.
        video: Draw a film of each episode.
        size: Width and height of the films, pixels.
        camera: Also draw films of this depth camera: front, side or wrist; give it again for more.
    """
    from xreset.eval.export import lerobot as dataset
    from xreset.eval.export import recorded

    recording = recorded.read_recorded(
        folders, engines=engine, robot=robot, meshes=meshes, task=task
    )
    with Progress() as bar:
        moved = bar.count("episodes")
        dataset.write_lerobot(
            out, recording, video=video, size=size, cameras=camera, progress=moved
        )
    _say(recording, out)


def npz(
    folders: Sources,
    *,
    out: Output,
    engine: Several = (),
    robot: Robot = None,
    task: str | None = None,
) -> None:
    """Write recorded evaluation episodes as plain arrays in one npz file (docs/rollouts.md has the schema).

    Args:
        folders: Run folders, or folders that xreset eval wrote into.
        out: File to write.
        engine: Only episodes of this engine; give it again for more. Default: all.
        task: The task in words; {object} is replaced by the object's name.
    """
    from xreset.eval.export import recorded

    recording = recorded.read_recorded(folders, engines=engine, robot=robot, task=task)
    recorded.write_arrays(out, recording)
    _say(recording, out)


def deploy(
    policy: Policy,
    *,
    out: Output,
    robot: Robot = None,
    meshes: TrainedMeshes = None,
    object: Several = (),
) -> None:
    """Write a policy for a robot: one ONNX graph from readings to joint targets, and a runtime.

    The runtime needs Python, numpy and onnxruntime (docs/live.md).

    Args:
        out: Folder to write; must not exist.
        object: Object whose points the contract lists; give it again for more. Default: the objects of the training.
    """
    from xreset.eval.export import deploy as deployment

    spec = deployment.export_deploy(policy, out, robot=robot, meshes=meshes, only=object)
    contract = runtime.load_controller(out).contract
    named = []
    for name, entry in contract["objects"].items():
        named.append(f"{name} ({'stand-in' if entry['source'] == 'stand-in' else 'mesh'})")
    rate = 1.0 / contract["control_dt"]
    console.print(
        f"{out}: {spec.name} for {contract['robot']}, {len(contract['joints'])} joints at {rate:g} Hz"
    )
    console.print(f"objects: {', '.join(named)}")
    console.print(f"Try it: cd {out} && python -m runtime")


def _say(recording: recorded.RecordedEpisodes, out: Path) -> None:
    engines = ", ".join(recording.episodes["engine"].unique())
    console.print(
        f"{out}: {len(recording.episodes)} episodes of {recording.robot.name} in {engines},"
        f" {recording.offsets[-1]} frames at {recording.fps:g} per second"
    )


COMMAND = {"lerobot": lerobot, "npz": npz, "deploy": deploy}
