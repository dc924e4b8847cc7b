"""What happened, in all engines side by side: pictures at a few times, and a film."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from xreset.eval.engines.replay import EngineTrace, TraceResult
from xreset.eval.plots import COLORS, figure_style, picture
from xreset.eval.report.clips import camera_at, encode_mp4
from xreset.files import write_whole
from xreset.pictures.render import Renderer, pose_matrix

SIZE = (320, 300)
"""Width and height of one engine's picture [pixels]; even, as video encoders ask."""
FRAMES_PER_SECOND = 20.0
_BANNER = 24  # height of an engine's name [pixels]


def write_strip(
    path: Path, result: TraceResult, *, count: int = 7, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Write a PNG: a row per engine, the reference first, and a column for each of ``count`` times, spread over the sequence."""
    engines = (result.reference, *result.engines)
    total = len(result.actions.joint_target)
    steps = np.unique(np.linspace(0, total - 1, count).round().astype(int))
    renderer = _renderer(result)
    dt = result.actions.scene.control_dt
    with picture(path, (2.0 * len(steps), 1.95 * len(engines) + 0.5), dpi=110, font_size=9) as figure:
        grid = figure.subplots(len(engines), len(steps), squeeze=False)
        figure.suptitle(result.actions.label)
        for row, (engine, axes) in enumerate(zip(engines, grid, strict=True)):
            for column, (step, ax) in enumerate(zip(steps.tolist(), axes, strict=True)):
                ax.imshow(_picture(renderer, engine, step))
                ax.set_xticks([])
                ax.set_yticks([])
                if row == 0:
                    time = (step + 1) * dt
                    ax.set_title(f"{time:.2f} s {result.actions.phase_at(time)}".rstrip(), fontsize="medium")
                progress(row * len(steps) + column + 1, len(engines) * len(steps))
            axes[0].set_ylabel(engine.name, color=COLORS[row % len(COLORS)], fontweight="bold")


def write_film(
    path: Path, result: TraceResult, *, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Write an mp4 at the sequence's own speed, engines side by side, the reference first."""
    engines = (result.reference, *result.engines)
    dt = result.actions.scene.control_dt
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * dt)))
    steps = list(range(0, len(result.actions.joint_target), every))
    renderer, banner = _renderer(result), _banner([e.name for e in engines])
    frames = []
    for i, step in enumerate(steps):
        pictures = np.concatenate([_picture(renderer, engine, step) for engine in engines], axis=1)
        frames.append(np.concatenate((banner, pictures)))
        progress(i + 1, len(steps))
    film = encode_mp4(np.stack(frames), 1.0 / (every * dt))
    write_whole(path, film)


def _picture(renderer: Renderer, engine: EngineTrace, step: int) -> np.ndarray:
    """[H, W, 3] the state after a control step; the last finite one where the engine's is not."""
    step = min(step, max(len(engine.differences.time) - 1, 0))
    r = engine.recording
    return renderer.draw(
        r.joint_pos[step, 0].numpy(), pose_matrix(r.object_pos[step, 0].numpy(), r.object_quat[step, 0].numpy())
    )


def _renderer(result: TraceResult) -> Renderer:
    """From the front right, near enough to see fingers, and far enough for the object's path in the reference."""
    path = result.reference.recording.object_pos[:, 0].double().numpy()
    low, high = path.min(axis=0), path.max(axis=0)
    camera = camera_at((low + high) / 2 + (0.0, 0.0, 0.05), 0.55 + 1.1 * float(np.linalg.norm(high - low)))
    return Renderer(result.actions.scene, size=SIZE, camera=camera)


def _banner(names: Sequence[str]) -> np.ndarray:
    """[24, W, 3] uint8: the engines' names, each over its picture."""
    width = SIZE[0] * len(names)
    with figure_style({"font.size": 10}) as figure_class:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        figure = figure_class(figsize=(width / 100, _BANNER / 100), dpi=100, facecolor="white")
        for i, name in enumerate(names):
            color = COLORS[i % len(COLORS)]
            figure.text((i + 0.5) / len(names), 0.5, name, ha="center", va="center", color=color, fontweight="bold")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
