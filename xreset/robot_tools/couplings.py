"""Turns what couples joints of an MJCF (equalities, tendons, closed loops) into joints that follow one driven joint.

MuJoCo states how far the equalities of a model are from being met. Each driven joint goes through its range, the
positions of the joints that are coupled to it are solved for, and straight lines are fitted to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components

SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
"""Hinges and slides have this type or a larger one; ball joints and free joints a smaller one."""
_SAMPLES = 25
"""Positions of the driven joint in which the others are solved for."""
_OPEN = 3e-3
"""[m] Gap that a closed loop may have when its joints follow straight lines."""
_CURVED = 0.05
"""[rad or m] How far two coupled joints may be off a straight line."""
_STILL = 2e-3
"""[rad or m] A coupled joint that moves by less is fixed."""
_DIGITS = 5
_EQUALITY = 1e6
_PULL = 1e3
_LIMIT = 1e2
_STAY = 1e-3
"""Weights of what coupled joints should do, the most important first: meet the equalities; let each tendon pull all its
joints alike; stay within the limits; let springs rest (weighted by their stiffness); stay where they were."""


Pull = dict[int, float]
"""Joints that an actuator moves, by their numbers, and by how much its length changes with each."""


class Line(NamedTuple):
    """``position = multiplier * position of the source + offset``; a joint that does not move has a multiplier of 0."""

    source: int
    multiplier: float
    offset: float


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return the name of a joint, or one made from its number."""
    return model.joint(joint).name or f"unnamed_joint{joint}"


class Couplings:
    """How the hinges and slides of a compiled model (Q of them) follow others."""

    def __init__(self, model: mujoco.MjModel, pulls: Sequence[Pull]) -> None:
        """Find the couplings of a model, whose options change; ``pulls`` are what its actuators move."""
        model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.model = model
        self.data = mujoco.MjData(model)
        self.joints = np.flatnonzero(model.jnt_type >= SLIDE)
        self.names = [repr(joint_name(model, joint)) for joint in self.joints.tolist()]
        self.address = model.jnt_qposadr[self.joints]
        self.start = model.qpos0[self.address]
        self.rest = model.qpos_spring[self.address]
        self.stiffness = np.sqrt(model.jnt_stiffness[self.joints])
        limited = model.jnt_limited[self.joints] > 0
        self.lower = np.where(limited, model.jnt_range[self.joints, 0], self.start - np.pi)
        self.upper = np.where(limited, model.jnt_range[self.joints, 1], self.start + np.pi)
        self.driven = [int(np.searchsorted(self.joints, next(iter(pull)))) for pull in pulls]
        rows = [np.zeros(len(self.joints))]
        for pull in pulls:
            (first, share), *others = pull.items()
            for joint, other in others:
                row = np.zeros(len(self.joints))
                row[self.joints == joint] = share
                row[self.joints == first] = -other
                rows.append(row)
        self.shared = np.stack(rows)
        """[S, Q] products with the positions are 0 where tendons pull all their joints alike."""
        self.lines: dict[int, Line] = {}
        """Follower -> its line, joints by their numbers; sources follow nothing."""
        self.notes: list[str] = []
        self.problems: list[str] = []
        """What cannot be stated by straight lines, each with a remedy."""
        for group in self._groups():
            self._couple(group)

    def lever(self, pull: Pull) -> tuple[int, float]:
        """Return the driven joint of an actuator, and by how much the actuator's length changes with it."""
        lever = 0.0
        source = next(iter(pull))
        for joint, share in pull.items():
            line = self.lines.get(joint, Line(joint, 1.0, 0.0))
            source = line.source
            lever += share * line.multiplier
        return source, lever

    def _gaps(self, q: np.ndarray) -> np.ndarray:
        """Return how far the equalities [E] are from being met at positions [Q]."""
        self.data.qpos[self.address] = q
        mujoco.mj_fwdPosition(self.model, self.data)
        return self.data.efc_pos[: self.data.ne].copy()

    def _jacobian(self, q: np.ndarray) -> np.ndarray:
        """[E, Q]"""
        self._gaps(q)
        dofs = self.model.jnt_dofadr[self.joints]
        return self.data.efc_J.reshape(-1, self.model.nv)[: self.data.ne, dofs]

    def _groups(self) -> list[np.ndarray]:
        """Return joints that depend on each other, by their indices."""
        if not len(self.joints):
            return []
        away = np.random.default_rng(0).uniform(0.01, 0.1, len(self.joints))
        rows = np.abs(np.vstack((self._jacobian(self.start + away), self.shared))) > 1e-9
        bound = rows.any(axis=0)
        _, labels = connected_components(rows.T.astype(int) @ rows.astype(int))
        return [np.flatnonzero((labels == label) & bound) for label in np.unique(labels[bound])]

    def _couple(self, group: np.ndarray) -> None:
        """Add the lines of joints that depend on each other."""
        drives = [joint for joint in dict.fromkeys(self.driven) if joint in group]
        jacobian = self._jacobian(self.start)[:, group]
        listed = ", ".join(self.names[i] for i in group)
        if len(drives) > 1 and len(group) - np.linalg.matrix_rank(jacobian, tol=1e-6) > 1:
            names = ", ".join(self.names[i] for i in drives)
            self.problems.append(
                f"the coupled joints {listed}, which {len(drives)} drives move ({names}), expected one. Use the "
                "maker's URDF with mimic joints, or state the couplings as equalities of two joints"
            )
            return
        if len(group) == 1:
            joint = int(self.joints[group[0]])
            self.lines[joint] = Line(joint, 0.0, float(self._closed(group, self.start)[0]))
            self.notes.append(f"{listed} is fixed, because an equality holds it in place")
            return
        source = drives[0] if drives else group[0]
        followers = group[group != source]
        values = np.linspace(self.lower[source], self.upper[source], _SAMPLES)
        solved = self._followed(followers, source, values)
        straight = solved.copy()
        lines = {}
        for follower in followers:
            track = solved[:, follower]
            multiplier = 0.0
            offset = float(track.mean())
            if np.ptp(track) > _STILL:
                multiplier, offset = (np.polyfit(values, track, 1).round(_DIGITS) + 0.0).tolist()
            straight[:, follower] = multiplier * values + offset
            lines[int(self.joints[follower])] = Line(int(self.joints[source]), multiplier, offset)
        opened, off = self._misfit(straight, np.abs(jacobian).max(axis=1, initial=0) > 1e-9)
        if opened > _OPEN or off > _CURVED:
            self.problems.append(
                f"the coupled joints {listed}, which do not move in proportion. Straight lines are "
                f"{off:.2g} rad (m) off and leave gaps of {1e3 * opened:.1f} mm in closed loops. Give equalities a "
                "polycoef with two numbers, remove the bar that closes a loop, or use the maker's URDF"
            )
            return
        self.lines |= lines
        names = ", ".join(self.names[i] for i in followers)
        loops = f"; closed loops stay closed within {1e3 * opened:.2f} mm" if opened else ""
        self.notes.append(f"coupled joints: {names} with {self.names[source]}{loops}")

    def _followed(self, followers: np.ndarray, source: int, values: np.ndarray) -> np.ndarray:
        """[V, Q] positions of all joints while a joint goes through values [V] and others follow it."""
        positions = np.tile(self.start, (len(values), 1))
        positions[:, source] = values
        before = self.start
        for q in positions:
            q[followers] = before[followers]  # so that the same solution is found
            q[followers] = self._closed(followers, q)
            before = q
        return positions

    def _misfit(self, positions: np.ndarray, rows: np.ndarray) -> tuple[float, float]:
        """Return the widest gap of a closed loop [m], and the most that another equality is off [rad or m].

        Args:
            positions: [V, Q] positions that are tried.
            rows: [E] bool: the equalities that count.
        """
        gaps = np.max([np.abs(self._gaps(q)) for q in positions], axis=0, initial=0)
        kinds = self.model.eq_type[self.data.efc_id[: len(gaps)]]
        is_loop = np.isin(kinds, (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)))
        return float(gaps[rows & is_loop].max(initial=0)), float(
            gaps[rows & ~is_loop].max(initial=0)
        )

    def _closed(self, free: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return positions of the free joints that meet what couples them, while the others stay at ``start`` [Q]."""
        q = start.copy()

        def cost(x: np.ndarray) -> np.ndarray:
            q[free] = x
            outside = x - np.clip(x, self.lower[free], self.upper[free])
            return np.concatenate(
                (
                    _EQUALITY * self._gaps(q),
                    _PULL * (self.shared @ q),
                    _LIMIT * outside,
                    self.stiffness[free] * (x - self.rest[free]),
                    _STAY * (x - start[free]),
                )
            )

        return least_squares(cost, start[free], xtol=1e-12, ftol=1e-12, max_nfev=400).x
