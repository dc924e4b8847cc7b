"""A policy that ships with xreset plays without the training stack, and its episodes are judged."""

import sys
from pathlib import Path

import xreset
from xreset.demos import write_demos
from xreset.eval.evaluate import resolve
from xreset.eval.setting import Setting
from xreset.eval.trial import engine


def main(out: Path) -> None:
    """Write ``demos.npz`` and the results of one episode in MuJoCo."""
    write_demos(out / "demos.npz", xreset.synthesize(["005_tomato_soup_can"], 1, seed=0))
    subject = resolve("soup-can", None, 0)
    (result,) = xreset.evaluate(subject, [engine("mujoco")], out / "demos.npz", Setting(num_envs=1), out / "eval", episodes=1)
    print(f"{result.policy} in {result.backend}: task progress {result.task_progress.mean:.0%}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
