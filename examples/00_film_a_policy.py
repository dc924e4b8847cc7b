"""A policy that ships with xreset grasps an object that it has never seen, in an engine that it was not trained in."""

import sys

import xreset


def main(meshes: str, name: str, out: str) -> None:
    """Make demonstrations of the mesh ``meshes/NAME.obj`` and a bank from them, and film the policy's first episode."""
    obj = xreset.load_object(name, meshes)
    demos = xreset.synthesize([name], 2, meshes=meshes)  # or xreset.read_demos("demos.npz")
    policy = xreset.load_policy("many-objects")  # or a run folder, or an .onnx file

    # robot states that follow the human hand
    motion = xreset.retarget_demos(demos, policy.robot, [obj])
    # those that MuJoCo finds stable
    bank = xreset.make_bank(motion, policy.robot, [obj])
    # the task that the policy was trained for
    with policy.make_env([obj], bank, engine="sapien") as env:
        xreset.film(policy, env, out)


if __name__ == "__main__":
    main(*sys.argv[1:])
