"""Hand keypoints of your own tracker become robot states, and those that an engine finds stable become a reset bank."""

import sys
from pathlib import Path

import numpy as np

import xreset


def record(file: Path) -> None:
    """Write what your tracker would record: 21 hand keypoints and the object's pose in each frame, millimetres, quaternions (x, y, z, w)."""
    hand = xreset.synthesize(["005_tomato_soup_can"], 1, seed=0)
    seen = hand.hand_valid
    np.savez(
        file,
        keypoints=1e3
        # [F, 21, 3] wrist, then each finger from base to tip, thumb first
        * hand.hand_keypoints[seen],
        object_pos=1e3 * hand.object_pos[seen],  # [F, 3]
        object_quat_xyzw=np.roll(hand.object_quat_wxyz[seen], -1, axis=1),  # [F, 4]
    )


def main(out: Path) -> None:
    """Write ``recorded.npz`` and ``bank.npz``."""
    record(out / "recorded.npz")
    demos = xreset.import_keypoints(
        out / "recorded.npz",
        # what the numbers mean is stated, never guessed
        order="mediapipe",
        units="mm",
        coordinates="table",
        fps=30.0,
        object_name="005_tomato_soup_can",
        side="right",
    )

    robot = xreset.load_robot("openarm")
    can = xreset.load_object("soup")
    motion = xreset.retarget_demos(demos, robot, [can])
    bank = xreset.make_bank(motion, robot, [can], num_envs=8)
    xreset.write_bank(out / "bank.npz", bank, config={}, inputs={})
    print(
        f"{int(motion.valid.sum())} of {demos.num_frames} frames can be reached, {bank.num_states} states are stable"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
