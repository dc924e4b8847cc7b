"""A trained policy is evaluated in several engines from the same starts, and what it reaches is plotted."""

import sys
from pathlib import Path

import xreset


def main(out: Path, engines: tuple[str, ...] = ("mujoco", "sapien")) -> None:
    """Write ``eval/`` (results, episode by episode) and ``progress.png``."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    unseen = xreset.synthesize(["005_tomato_soup_can"], 1, seed=1)  # or the file of demonstrations
    policy = "many-objects"  # ships with xreset; a run folder or an .onnx file will do
    results = xreset.evaluate(policy, unseen, engines, episodes=1, num_envs=1, out=out / "eval")

    figure, axes = pyplot.subplots(figsize=(5, 3), layout="constrained")
    parts = ("approach", "grasp", "reorient", "reorientation_progress")
    for number, result in enumerate(results):
        means = [result.mean(part) for part in parts]
        places = [i + 0.4 * number for i in range(len(parts))]
        axes.bar(places, means, width=0.38, label=f"{result.engine} {result.engine_version}")
        mean = result.mean("task_progress")
        progress = f"task progress {mean:.0%} in {len(result.episodes)} episodes"
        print(f"{result.policy} in {result.engine}: {progress}")
    axes.set_xticks(
        [i + 0.2 for i in range(len(parts))], [part.replace("_", "\n") for part in parts]
    )
    axes.set(ylim=(0, 1), ylabel="share")
    axes.legend(loc="lower left")
    figure.savefig(out / "progress.png", dpi=150)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
