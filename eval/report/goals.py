"""How far the goals of episodes are from the goals that the policy was trained with."""

from __future__ import annotations

import numpy as np

from xreset.errors import XResetError
from xreset.eval.report.read import Training
from xreset.geometry.shapes import pose_matrix, transformed
from xreset.learning.run import RunInfo
from xreset.objects.sampling import metric_points
from xreset.resets.inputs import load_inputs


def goal_distances(training: Training, run: RunInfo | None) -> np.ndarray:
    """Return the distance [E] of the goal of each episode from the nearest goal of the same object in the bank of the
    policy's training [m].

    It is the mean distance of the object's surface points between both poses: the published success measures the
    distance from the goal in the same way. So it holds position and orientation in one number, and does not depend on
    the mesh's origin. Goals that the training made of these (``goal_xy``, ``crossed_goals``) do not count.

    Args:
        training: evaluation of the policy. Goals are those of the recordings, because all episodes of a demonstration
            have the same goal.
        run: training of the policy.

    Returns:
        NaN for objects that the training did not have, and everywhere if the training is unknown, if its bank or meshes
        are missing or were replaced, or if nothing was recorded.
    """
    unknown = np.full(len(training.episodes), np.nan)
    if run is None:
        return unknown
    try:
        trained = load_inputs(
            run.resets, robot=run.robot, meshes=run.meshes, accept=("bank", "goals")
        )
        recorded = training.recorded()
    except XResetError:
        return unknown
    if trained.hash != run.resets_hash:
        return unknown
    bank = trained.bank
    distances = {}
    for obj in trained.objects:
        points = metric_points(obj)
        goals = []
        for i in np.flatnonzero(bank.sequence_object == obj.name):
            goals.append(transformed(points, pose_matrix(bank.goal_pos[i], bank.goal_quat_wxyz[i])))
        for row in recorded[recorded["object"] == obj.name].itertuples():
            goal = transformed(points, pose_matrix(row.trace.goal_pos, row.trace.goal_quat))
            apart = np.linalg.norm(np.stack(goals) - goal, axis=2).mean(axis=1)
            distances[row.engine, row.sequence] = apart.min()
    episodes = zip(training.episodes["engine"], training.episodes["sequence"], strict=True)
    return np.array([distances.get(episode, np.nan) for episode in episodes])
