"""A robot of your own under a policy: a driver. This one replays a recorded episode, so no robot moves.

The folder is that of `xreset export deploy`. Its package runtime needs numpy and onnxruntime, and neither xreset nor torch.
"""

import sys
from pathlib import Path

import numpy as np


def main(folder: Path, recording: Path, episode: int = 0) -> None:
    """Run a policy on an episode of `xreset export episodes`; print how far its targets are from the recorded ones."""
    sys.path.insert(0, str(folder))
    import runtime

    class ReplayedRobot(runtime.Driver):
        """Reads what was recorded, whatever it is told. A robot has its own clock: leave out now and wait_until."""

        def __init__(self) -> None:
            with np.load(recording) as file:
                rows = slice(*file["frame_offsets"][episode : episode + 2])
                self.frames = {
                    name: file[name][rows]
                    for name in file.files
                    if name.startswith(("time", "joint_p", "joint_t", "object_p", "object_q"))
                }
                self.goal = file["goal_pos"][episode], file["goal_quat_wxyz"][episode]
                self.object_name = str(file["object_name"][episode])
            self.joint_vel = np.gradient(self.frames["joint_pos"], self.frames["time"], axis=0)
            self.clock = 0.0
            self.errors = []

        def now(self):
            return self.clock

        def wait_until(self, moment):
            self.clock = moment

        def read(self):
            self.row = np.searchsorted(self.frames["time"], self.clock + 1e-6) - 1
            return runtime.Reading(
                joint_pos=self.frames["joint_pos"][self.row],
                joint_vel=self.joint_vel[self.row],
                joint_time=self.frames["time"][self.row],
                object_pos=self.frames["object_pos"][self.row],
                object_quat=self.frames["object_quat_wxyz"][self.row],
                object_time=self.frames["time"][self.row],
            )

        def send(self, target):
            self.errors.append(np.abs(target - self.frames["joint_target"][self.row]).mean())

        def stop(self):
            print("the robot holds still")

    robot = ReplayedRobot()
    controller = runtime.load_controller(folder)
    name = robot.object_name
    controller.begin(
        controller.points(name), *robot.goal, robot.frames["joint_pos"][0], controller.center(name)
    )
    outcome = runtime.Runner(controller, robot).run(float(robot.frames["time"][-1]))
    print(f"{outcome.steps} steps; stopped because: {outcome.reason or 'the recording is over'}")
    print(f"targets differ from the recorded ones by {np.mean(robot.errors):.3f} rad")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
