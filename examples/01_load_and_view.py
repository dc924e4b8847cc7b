"""Load a robot, an object and demonstrations, and draw them; `xreset view demos.npz` shows the same file in a browser."""

import sys
from pathlib import Path

import xreset
from xreset.pictures.render import write_png
from xreset.pictures.view.load import load_view
from xreset.pictures.view.picture import Drawer
from xreset.robot_tools.picture import robot_picture


def main(out: Path) -> None:
    """Write ``robot.png``, ``demos.npz`` and ``demos.png``."""
    robot = xreset.load_robot("ur7e-sharpa")
    write_png(out / "robot.png", robot_picture(robot))

    # a built-in stand-in; a folder of meshes is the second argument
    can = xreset.load_object("soup")
    demos = xreset.synthesize([can.name], 2, seed=0)  # or xreset.read_demos("demos.npz")
    xreset.write_demos(out / "demos.npz", demos)
    view = load_view(out / "demos.npz", demos=None, robot=None, meshes=None)
    write_png(out / "demos.png", Drawer(view, smooth=True).draw(row=60))

    print(
        f"{robot.name}: {len(robot.joints)} joints, fingertips {', '.join(robot.fingertip_names)}"
    )
    print(
        f"{can.name}: {can.mass:.2f} kg, {len(can.pieces)} convex pieces; {len(demos)} demonstrations, {demos.num_frames} frames"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
