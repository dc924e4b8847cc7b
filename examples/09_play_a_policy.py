"""A policy plays without the training stack: onnxruntime and numpy read the file, which states its inputs and outputs.

Only the worlds come from xreset here; on a robot, your own code fills the same arrays.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import torch

import xreset
from xreset.files.checks import from_dict
from xreset.policy.shipped import shipped
from xreset.resets.inputs import load_inputs
from xreset.task.config import TaskConfig, evaluation_task


def main(demos: Path, policy: Path | None = None) -> None:
    """Play the first demonstration's goal from home in MuJoCo and print where the object ends; ``demos``: a file of example 01."""
    session = onnxruntime.InferenceSession(policy or shipped()["many-objects"])
    contract = json.loads(session.get_modelmeta().custom_metadata_map["xreset"])
    for group in ("policy", "proprio"):  # in this order they are the input `flat`
        print(
            f"{group}: {', '.join(f'{name} {width}' for name, width in contract['observation_layout'][group].items())}"
        )
    print(
        f"one action for each of {len(contract['joint_names'])} joints, every {contract['control_dt'] * 1e3:.1f} ms"
    )

    robot = xreset.load_robot(contract["robot"])
    task = evaluation_task(from_dict(TaskConfig, contract["task"]))
    inputs = load_inputs(demos, robot=robot)
    with xreset.make_env(robot, inputs.objects, inputs.bank, task, num_envs=1) as env:
        lstm = [
            np.zeros((1, env.num_envs, given.shape[2]), np.float32)
            for given in session.get_inputs()[2:]
        ]
        for _ in range(env.max_episode_length - 1):
            seen = {name: value.numpy() for name, value in env.get_observations().items()}
            flat = np.concatenate((seen["policy"], seen["proprio"]), axis=1)
            feed = {"flat": flat, "cloud": seen["perception"], "h_in": lstm[0], "c_in": lstm[1]}
            actions, *lstm = session.run(None, feed)
            env.step(torch.from_numpy(actions).clamp(-1.0, 1.0))
        away = (env.backend.state().object_pos - env.goal_pos).norm(dim=1)
    print(f"the object ends {100 * away.item():.1f} cm from its goal")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "demos.npz"),
        Path(sys.argv[2]) if len(sys.argv) > 2 else None,
    )
