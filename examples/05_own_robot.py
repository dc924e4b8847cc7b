"""A robot of your own: a folder with a URDF and a robot.toml. Here the OpenArm with a stiffer gripper, on a higher base.

`xreset robots import --arm ARM --hand HAND --out FOLDER` writes such a folder from what makers publish. A package makes it known by name:

    [project.entry-points."xreset.robots"]
    my-robot = "my_package.my_robot"          # the module next to robot.toml
"""

import shutil
import sys
from pathlib import Path

import xreset
from xreset.physics.plugins import robot_folder
from xreset.pictures.render import write_png
from xreset.robot_tools.check import check
from xreset.robot_tools.picture import robot_picture


def main(out: Path) -> None:
    """Write the folder ``my-robot`` with a picture in it, and check it."""
    folder = out / "my-robot"
    folder.mkdir(exist_ok=True)
    for file in ("robot.toml", "robot.urdf"):
        shutil.copy(robot_folder("openarm") / file, folder / file)
    description = (folder / "robot.toml").read_text()
    for old, new in (
        ('name = "openarm"', 'name = "my-robot"'),
        ("pos = [0.45, 0.60, 0.55]", "pos = [0.45, 0.60, 0.58]"),
        ("kp = 2000.0, kd = 55.3", "kp = 3000.0, kd = 68.0"),
    ):
        assert old in description, old
        description = description.replace(old, new)
    (folder / "robot.toml").write_text(description)

    findings = check(folder)  # everything that is wrong with it, at once
    for finding in findings:
        print(f"{finding.level:8} {finding.topic}: {finding.message}")
    robot = xreset.load_robot(str(folder))  # wherever a robot is asked for, a folder will do
    write_png(folder / "robot.png", robot_picture(robot))
    print(f"{robot.name}: {sum(finding.level == 'error' for finding in findings)} errors")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
