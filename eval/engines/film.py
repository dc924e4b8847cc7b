"""What happened in all engines next to each other: pictures at a few times, and a film."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xreset.eval.engines.replay import EngineTrace, TraceResult
from xreset.eval.plots import COLORS, figure_style, picture
from xreset.eval.report.clips import camera_at, encode_mp4
from xreset.eval.rollout import Progress
from xreset.files import write_whole
from xreset.pictures.render import Renderer, pose_matrix

SIZE = (320, 300)
"""Width and height of one engine's picture [pixels]; even, as video encoders ask."""
FRAMES_PER_SECOND = 20.0
BANNER = 24
"""Height of an engine's name [pixels]."""


def write_strip(
    path: Path, result: TraceResult, *, count: int = 7, progress: Progress = lambda done, total: None
) -> None:
    """Write a PNG: a row for each engine, the reference first, and ``count`` columns spread over the sequence."""
    engines = (result.reference, *result.engines)
    actions = result.actions
    steps = np.unique(np.linspace(0, len(actions.joint_target) - 1, count).round().astype(int)).tolist()
    renderer = _renderer(result)
    with picture(path, (2.0 * len(steps), 1.95 * len(engines) + 0.5), dpi=110, font_size=9) as figure:
        axes = figure.subplots(len(engines), len(steps), squeeze=False, subplot_kw={"xticks": [], "yticks": []})
        figure.suptitle(actions.label)
        for column, step in enumerate(steps):
            time = (step + 1) * actions.scene.control_dt
            axes[0, column].set_title(f"{time:.2f} s {actions.phase_at(time)}".rstrip(), fontsize="medium")
        for row, engine in enumerate(engines):
            axes[row, 0].set_ylabel(engine.name, color=COLORS[row % len(COLORS)], fontweight="bold")
            for column, step in enumerate(steps):
                axes[row, column].imshow(_picture(renderer, engine, step))
                progress(row * len(steps) + column + 1, axes.size)


def write_film(path: Path, result: TraceResult, *, progress: Progress = lambda done, total: None) -> None:
    """Write an mp4 at the sequence's own speed, with the engines next to each other, the reference first."""
    engines = (result.reference, *result.engines)
    dt = result.actions.scene.control_dt
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * dt)))
    steps = range(0, len(result.actions.joint_target), every)
    renderer = _renderer(result)
    banner = _banner([e.name for e in engines])
    frames = []
    for i, step in enumerate(steps):
        pictures = np.concatenate([_picture(renderer, engine, step) for engine in engines], axis=1)
        frames.append(np.concatenate((banner, pictures)))
        progress(i + 1, len(steps))
    write_whole(path, encode_mp4(np.stack(frames), 1.0 / (every * dt)))


def _picture(renderer: Renderer, engine: EngineTrace, step: int) -> np.ndarray:
    """[H, W, 3] the state after a control step; the last finite one where the engine's is not finite."""
    step = min(step, max(len(engine.differences.time) - 1, 0))
    r = engine.recording
    pose = pose_matrix(r.object_pos[step, 0].numpy(), r.object_quat[step, 0].numpy())
    return renderer.draw(r.joint_pos[step, 0].numpy(), pose)


def _renderer(result: TraceResult) -> Renderer:
    """From the front right, near enough to see fingers, and far enough for the object's path in the reference."""
    path = result.reference.recording.object_pos[:, 0].double().numpy()
    low = path.min(axis=0)
    high = path.max(axis=0)
    camera = camera_at((low + high) / 2 + (0.0, 0.0, 0.05), 0.55 + 1.1 * float(np.linalg.norm(high - low)))
    return Renderer(result.actions.scene, size=SIZE, camera=camera)


def _banner(names: list[str]) -> np.ndarray:
    """[BANNER, W, 3] uint8: each engine's name above its picture."""
    with figure_style({"font.size": 10}) as figure_class:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        figure = figure_class(figsize=(SIZE[0] * len(names) / 100, BANNER / 100), dpi=100, facecolor="white")
        for i, name in enumerate(names):
            color = COLORS[i % len(COLORS)]
            figure.text((i + 0.5) / len(names), 0.5, name, ha="center", va="center", color=color, fontweight="bold")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
