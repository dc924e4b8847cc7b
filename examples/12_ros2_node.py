"""A deployed policy as a ROS 2 node. It was tested against a small stand-in for rclpy, not with ROS 2."""

import sys
from functools import partial

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

TOPICS = {"joint_states": JointState, "object_pose": PoseStamped, "goal_pose": PoseStamped}


def main(folder: str, object_name: str, seconds: float = float("inf")) -> None:
    """Run the policy in a folder of `xreset export deploy`. Poses are in the world frame of docs/live.md."""
    sys.path.insert(0, folder)
    import runtime

    class RosRobot(runtime.Driver):
        """The newest message of each topic; targets go to a forward_command_controller."""

        def __init__(self, node):
            self.node, self.newest = node, {}
            for topic, kind in TOPICS.items():
                node.create_subscription(kind, topic, partial(self.newest.__setitem__, topic), 1)
            self.targets = node.create_publisher(Float64MultiArray, "forward_commands", 1)
            while rclpy.ok() and len(self.newest) < len(TOPICS):
                rclpy.spin_once(node)

        def now(self):
            return self.node.get_clock().now().nanoseconds * 1e-9

        def wait_until(self, moment):
            while rclpy.ok() and self.now() < moment:
                rclpy.spin_once(self.node, timeout_sec=moment - self.now())

        def pose(self, topic):
            p, q = self.newest[topic].pose.position, self.newest[topic].pose.orientation
            return [p.x, p.y, p.z], [q.w, q.x, q.y, q.z]

        def read(self):
            joints, (pos, quat) = self.newest["joint_states"], self.pose("object_pose")
            rows = controller.rows(joints.name)
            stamps = [self.newest[topic].header.stamp for topic in TOPICS]
            times = [stamp.sec + stamp.nanosec * 1e-9 for stamp in stamps]
            return runtime.Reading(
                joint_pos=np.array(joints.position)[rows],
                joint_vel=np.array(joints.velocity)[rows] if len(joints.velocity) else None,
                joint_time=times[0], object_pos=pos, object_quat=quat, object_time=times[1],
            )  # fmt: skip

        def send(self, target):
            self.targets.publish(Float64MultiArray(data=target.tolist()))
            controller.set_goal(*self.pose("goal_pose"))  # for the next step

        def stop(self): ...  # the controller of ROS holds the last targets

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C is for the runner
    controller = runtime.load_controller(folder)
    robot = RosRobot(rclpy.create_node("policy"))
    obj = controller.object(object_name)
    controller.begin(obj, *robot.pose("goal_pose"), robot.read().joint_pos)
    print(runtime.Runner(controller, robot).run(seconds).reason)


if __name__ == "__main__":
    main(*sys.argv[1:3])
