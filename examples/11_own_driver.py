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
                joints = controller.rows(file["joint_names"])
                self.times = file["time"][rows]
                self.joint_pos = file["joint_pos"][rows][:, joints]
                self.targets = file["joint_target"][rows][:, joints]
                self.poses = file["object_pos"][rows], file["object_quat_wxyz"][rows]
                self.goal = file["goal_pos"][episode], file["goal_quat_wxyz"][episode]
                self.object = str(file["object_name"][episode])
            self.joint_vel = np.gradient(self.joint_pos, self.times, axis=0)
            self.clock = 0.0
            self.errors = []

        def now(self):
            return self.clock

        def wait_until(self, moment):
            k = self.frame(self.clock)
            if self.frame(moment) > k:  # the recorded target is the last one before the next frame
                self.errors.append(np.abs(controller.target - self.targets[k]).mean())
                controller.target = self.targets[[k]]  # else differences add up
            self.clock = moment

        def frame(self, moment):
            return np.searchsorted(self.times, moment + 1e-6) - 1

        def read(self):
            k = self.frame(self.clock)
            return runtime.Reading(
                joint_pos=self.joint_pos[k], joint_vel=self.joint_vel[k], joint_time=self.times[k],
                object_pos=self.poses[0][k], object_quat=self.poses[1][k], object_time=self.times[k],
            )  # fmt: skip

        def send(self, target): ...

        def stop(self):
            print("the robot holds still")

    controller = runtime.load_controller(folder)
    robot = ReplayedRobot()
    controller.begin(controller.object(robot.object), *robot.goal, robot.joint_pos[0])
    outcome = runtime.Runner(controller, robot).run(float(robot.times[-1]))
    print(f"{outcome.steps} steps; stopped because: {outcome.reason or 'the recording is over'}")
    print(f"targets differ from the recorded ones by {np.mean(robot.errors):.3f} rad")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
