"""Human demonstrations become robot states, and those that a physics engine finds stable become a reset bank."""

import sys
from pathlib import Path

import xreset
from xreset.pictures.raster import write_png
from xreset.resets.bank import write_bank
from xreset.robot_tools.picture import robot_picture


def main(out: Path) -> None:
    """Write ``robot.png`` and ``bank.npz``."""
    robot = xreset.load_robot("openarm")
    write_png(out / "robot.png", robot_picture(robot))
    can = xreset.load_object("soup")
    demos = xreset.synthesize([can.name], 1, seed=0)
    motion = xreset.retarget_demos(demos, robot, [can])
    bank = xreset.make_bank(motion, robot, [can], ["mujoco"], num_envs=8)
    write_bank(out / "bank.npz", bank, config={}, inputs={})
    print(f"{int(motion.valid.sum())} of {len(motion.valid)} frames can be reached, {bank.num_states} states are stable")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
