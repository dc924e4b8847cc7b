"""Turns what couples joints of an MJCF (equalities, tendons, closed loops) into joints that follow one driven joint."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

_SAMPLES = 25
"""Positions of the driven joint in which a loop is closed and a curve is read."""
_OPEN = 3e-3
"""[m] Gap that a loop may have when its joints follow straight lines."""
_CURVED = 0.05
"""[rad or m] By which a coupling by a curve may be off its straight line."""
_MOST_LOOPS = 20
_STILL = 2e-3
"""[rad or m] A joint of a loop that moves by less is fixed."""
_GAP_WEIGHT = 1e4
"""[1/m] Weight of a gap against springs, which then open a loop by hundredths of a millimetre."""
_STAY = 1e-3
_DIGITS = 5


class Line(NamedTuple):
    """``joint = multiplier * source + offset``"""

    joint: Any
    source: Any
    multiplier: float
    offset: float


@dataclass(kw_only=True)
class Couplings:
    """How joints of a model follow others; joints by their numbers."""

    lines: list[Line] = field(default_factory=list)
    """One line for each follower; sources follow nothing."""
    held: dict[int, float] = field(default_factory=dict)
    """Joints that do not move, and where they are."""
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    """What cannot be said by straight lines, each with a remedy."""

    def lever(self, joints: Iterable[int], shares: Iterable[float]) -> tuple[int, float]:
        """Return the driven joint of an actuator, and by how much the actuator's length changes with it."""
        lines = {line.joint: line for line in self.lines}
        lever = 0.0
        source = -1
        for joint, share in zip(joints, shares, strict=True):
            line = lines.get(joint, Line(joint, joint, 1.0, 0.0))
            source = line.source
            lever += share * line.multiplier
        return source, lever


def resolved(lines: Sequence[Line], first: Iterable[Hashable] = ()) -> list[Line]:
    """Return lines whose sources follow nothing, one for each follower.

    Args:
        lines: may form chains; each can be read in either direction.
        first: joints that become sources where possible, in this order; the others are those that follow nothing.

    Raises:
        ValueError: joints follow one another in a circle.
    """
    neighbors = defaultdict(list)
    for line in lines:
        neighbors[line.source].append(line)
        if line.multiplier:
            inverse = 1 / line.multiplier
            neighbors[line.joint].append(Line(line.source, line.joint, inverse, -line.offset * inverse))
    followers = {line.joint for line in lines}
    roots = [joint for joint in first if joint in neighbors]
    roots += [line.source for line in lines if line.source not in followers]
    found: dict[Any, Line] = {}
    for root in roots:
        if root in found:
            continue
        found[root] = Line(root, root, 1.0, 0.0)
        stack = [root]
        while stack:
            here = found[stack.pop()]
            for line in neighbors[here.joint]:
                if line.joint not in found:
                    offset = line.multiplier * here.offset + line.offset
                    found[line.joint] = Line(line.joint, root, line.multiplier * here.multiplier, offset)
                    stack.append(line.joint)
    if left := [str(line.joint) for line in lines if line.joint not in found]:
        raise ValueError(f"joints follow one another in a circle: {', '.join(left)}")
    return [line for line in found.values() if line.joint != line.source]


def tendon_joints(model: Any, mujoco: Any, tendon: int) -> tuple[list[int], list[float]] | None:
    """Return the joints of a fixed tendon and their coefficients; None for a tendon that runs through space."""
    wraps = range(int(model.tendon_adr[tendon]), int(model.tendon_adr[tendon] + model.tendon_num[tendon]))
    if any(int(model.wrap_type[i]) != int(mujoco.mjtWrap.mjWRAP_JOINT) for i in wraps):
        return None
    return [int(model.wrap_objid[i]) for i in wraps], [float(model.wrap_prm[i]) for i in wraps]


def read_couplings(model: Any, mujoco: Any) -> Couplings:
    """Return how the joints of a compiled model follow others."""
    found = Couplings()
    lines: list[Line] = []
    driven = []
    tendons = []
    for actuator in range(model.nu):
        kind = int(model.actuator_trntype[actuator])
        target = int(model.actuator_trnid[actuator, 0])
        if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
            driven.append(target)
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            tendons.append(target)
        else:
            found.notes.append(f"left out: the actuator {model.actuator(actuator).name!r}, which drives no joint")
    try:
        _read_equalities(model, mujoco, found, lines)
        _read_tendons(model, mujoco, found, lines, driven, tendons)
        found.lines = resolved(lines, driven)
        loops = _loops(model, mujoco)
        if len(loops) > _MOST_LOOPS:
            found.problems.append(f"{len(loops)} closed loops, expected {_MOST_LOOPS} at most. Remove bars of linkages")
        elif loops:
            _close(model, mujoco, found, loops, driven)
    except (ValueError, ZeroDivisionError) as error:
        found.problems.append(f"equalities or tendons that cannot be read ({error}). Remove what couples these joints")
    return found


def _name(model: Any, joint: int) -> str:
    return repr(model.joint(joint).name or f"joint{joint}")


def _limits(model: Any, joint: int) -> tuple[float, float]:
    """Return the limits of a joint; half a turn to either side of where it is in the file if it has none."""
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint].tolist()
        return low, high
    middle = float(model.qpos0[model.jnt_qposadr[joint]])
    return middle - np.pi, middle + np.pi


def _samples(model: Any, joint: int) -> np.ndarray:
    low, high = _limits(model, joint)
    return np.linspace(low, high, _SAMPLES)


def _read_equalities(model: Any, mujoco: Any, found: Couplings, lines: list[Line]) -> None:
    for number in range(model.neq):
        if not model.eq_active0[number]:
            continue
        equality = model.equality(number)
        name = equality.name or number
        kind = mujoco.mjtEq(int(model.eq_type[number]))
        first = int(model.eq_obj1id[number])
        second = int(model.eq_obj2id[number])
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            start = float(model.qpos0[model.jnt_qposadr[first]])
            if second < 0:
                found.held[first] = start + float(equality.data[0])
                found.notes.append(f"{_name(model, first)} is fixed, because the equality {name!r} holds it in place")
                continue
            shift = float(model.qpos0[model.jnt_qposadr[second]])
            curve = np.polynomial.Polynomial(equality.data[:5])
            offset = float(equality.data[0])
            multiplier = float(equality.data[1])
            if np.abs(equality.data[2:5]).max() > 0:
                x = _samples(model, second) - shift
                multiplier, offset = np.polyfit(x, curve(x), 1).round(_DIGITS).tolist()
                away = float(np.abs(offset + multiplier * x - curve(x)).max())
                if away > _CURVED:
                    found.problems.append(
                        f"the equality {name!r}, which couples joints by a curve that is {away:.2g} rad (m) off a "
                        "straight line. Give it a polycoef with two numbers"
                    )
                    continue
                found.notes.append(f"the curve of the equality {name!r} is replaced by a line, {away:.2g} rad (m) off")
            lines.append(Line(first, second, multiplier, offset + start - multiplier * shift))
        elif kind == mujoco.mjtEq.mjEQ_TENDON:
            joints, shares = tendon_joints(model, mujoco, first) or ([], [])
            if second >= 0 or len(joints) != 2:
                found.problems.append(
                    f"the equality {name!r} of tendons. State it as equalities of two joints: "
                    '<joint joint1="A" joint2="B" polycoef="0 1 0 0 0"/>'
                )
                continue
            length = float(model.tendon_length0[first] + equality.data[0])
            lines.append(Line(joints[1], joints[0], -shares[0] / shares[1], length / shares[1]))
        elif kind != mujoco.mjtEq.mjEQ_CONNECT:
            found.problems.append(
                f"the equality {name!r} of type {kind.name.removeprefix('mjEQ_').lower()}. If it welds two bodies, "
                "put one into the other, without a joint"
            )


def _read_tendons(
    model: Any, mujoco: Any, found: Couplings, lines: list[Line], driven: list[int], tendons: list[int]
) -> None:
    """A tendon with an actuator moves its joints together, in proportion to their coefficients: each takes the
    coefficient's share of the tendon's force."""
    for tendon in range(model.ntendon):
        name = model.tendon(tendon).name or tendon
        parts = tendon_joints(model, mujoco, tendon)
        if tendon not in tendons:
            found.notes.append(f"left out: the tendon {name!r}, which no actuator pulls")
        elif parts is None:
            found.problems.append(
                f"the tendon {name!r}, which runs through space. Drive its joint by a position actuator of its own, or "
                "couple its joints by an equality"
            )
        else:
            joints, shares = parts
            source = joints[0]
            driven.append(source)
            for joint, share in zip(joints[1:], shares[1:], strict=True):
                roots = {line.joint: line.source for line in resolved(lines)}
                if roots.get(joint, joint) != roots.get(source, source):
                    lines.append(Line(joint, source, share / shares[0], 0.0))
                    found.notes.append(
                        f"{_name(model, joint)} follows {_name(model, source)}, because the tendon {name!r} pulls both"
                    )


# Closed loops ---------------------------------------------------------------------------------------------------------


class _Loop(NamedTuple):
    """A point of one body that stays at a point of another."""

    name: str
    joints: frozenset[int]
    """Joints that move one of the bodies and not the other."""
    gap: Any
    """Function of MuJoCo's data that returns the vector [3] between the points."""


def _loops(model: Any, mujoco: Any) -> list[_Loop]:
    loops = []
    for number in range(model.neq):
        if not model.eq_active0[number] or int(model.eq_type[number]) != int(mujoco.mjtEq.mjEQ_CONNECT):
            continue
        pair = (int(model.eq_obj1id[number]), int(model.eq_obj2id[number]))
        sites = int(model.eq_objtype[number]) == int(mujoco.mjtObj.mjOBJ_SITE)
        bodies = tuple(int(model.site_bodyid[i]) for i in pair) if sites else pair
        anchors = (model.eq_data[number, :3].copy(), model.eq_data[number, 3:6].copy())

        def gap(data: Any, pair: tuple = pair, anchors: tuple = anchors, sites: bool = sites) -> np.ndarray:
            points = []
            for i, anchor in zip(pair, anchors, strict=True):
                points.append(data.site_xpos[i] if sites else data.xpos[i] + data.xmat[i].reshape(3, 3) @ anchor)
            return points[0] - points[1]

        first, second = (_joints_above(model, body) for body in bodies)
        loops.append(_Loop(str(model.equality(number).name or number), frozenset(first ^ second), gap))
    return loops


def _joints_above(model: Any, body: int) -> set[int]:
    joints = set()
    while body:
        first = int(model.body_jntadr[body])
        joints |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return joints


def _moving(loops: list[_Loop]) -> frozenset[int]:
    return frozenset().union(*(loop.joints for loop in loops))


def _close(model: Any, mujoco: Any, found: Couplings, loops: list[_Loop], driven: list[int]) -> None:
    """Add lines for the joints of closed loops that nothing else drives."""
    lines = {line.joint: line for line in found.lines}
    for joint in driven:
        lines.setdefault(joint, Line(joint, joint, 1.0, 0.0))
    for line in found.lines:
        lines.setdefault(line.source, Line(line.source, line.source, 1.0, 0.0))
    groups: list[list[_Loop]] = []
    for loop in loops:  # loops that share a joint without a drive are closed together
        free = loop.joints - lines.keys()
        apart = []
        joined = [loop]
        for group in groups:
            if free & _moving(group):
                joined += group
            else:
                apart.append(group)
        groups = [*apart, joined]
    for group in groups:
        names = ", ".join(loop.name for loop in group)
        joints = _moving(group)
        free = sorted(joints - lines.keys() - found.held.keys())
        sources = {lines[joint].source for joint in joints if joint in lines}
        if not free:  # equalities of joints close it
            continue
        if len(sources) != 1:
            drives = ", ".join(_name(model, joint) for joint in sources) or "none"
            found.problems.append(
                f"the closed loop {names!r}, which {len(sources)} drives move ({drives}), expected one. Use the "
                "maker's URDF with mimic joints, or state the coupling as equalities of two joints"
            )
            continue
        source = sources.pop()
        values = _samples(model, source)
        moved = {joint: line for joint, line in lines.items() if line.source == source}
        positions = _closed(model, mujoco, group, free, moved, found.held, values)
        fitted = []
        for joint, track in zip(free, positions.T, strict=True):
            if np.ptp(track) < _STILL:
                fitted.append(Line(joint, source, 0.0, float(track.mean())))
            else:
                multiplier, offset = (np.polyfit(values, track, 1).round(_DIGITS) + 0.0).tolist()
                fitted.append(Line(joint, source, multiplier, offset))
        straight = np.stack([line.multiplier * values + line.offset for line in fitted], axis=1)
        data = mujoco.MjData(model)
        opened = 0.0
        for value, row in zip(values, straight, strict=True):
            _put(model, mujoco, data, moved, found.held, value, free, row)
            opened = max(opened, *(float(np.linalg.norm(loop.gap(data))) for loop in group))
        if opened > _OPEN:
            found.problems.append(
                f"the closed loop {names!r}, whose joints do not move in proportion: as coupled joints they would open "
                f"it by {1e3 * opened:.1f} mm. Remove the bar that closes the loop, or use the maker's URDF"
            )
            continue
        for line in fitted:
            if line.multiplier:
                found.lines.append(line)
            else:
                found.held[line.joint] = line.offset
        listed = ", ".join(_name(model, joint) for joint in free)
        found.notes.append(
            f"the closed loop {names!r} is replaced by coupled joints ({listed} with {_name(model, source)}), which "
            f"close it within {1e3 * opened:.2f} mm"
        )


def _put(
    model: Any,
    mujoco: Any,
    data: Any,
    moved: dict[int, Line],
    held: dict[int, float],
    value: float,
    free: Sequence[int],
    positions: np.ndarray,
) -> None:
    for joint, line in moved.items():
        data.qpos[model.jnt_qposadr[joint]] = line.multiplier * value + line.offset
    for joint, position in held.items():
        data.qpos[model.jnt_qposadr[joint]] = position
    data.qpos[model.jnt_qposadr[free]] = positions
    mujoco.mj_kinematics(model, data)


def _closed(
    model: Any,
    mujoco: Any,
    loops: list[_Loop],
    free: list[int],
    moved: dict[int, Line],
    held: dict[int, float],
    values: np.ndarray,
) -> np.ndarray:
    """[V, Q] positions of the free joints that close the loops, where springs rest as far as they can, for positions
    [V] of the driven joint."""
    data = mujoco.MjData(model)
    address = model.jnt_qposadr[free]
    stiffness = np.sqrt(model.jnt_stiffness[free])
    rest = model.qpos_spring[address]
    low, high = np.array([_limits(model, joint) for joint in free]).T
    inside = 1e-6 * (high - low)
    before = np.clip(model.qpos0[address], low + inside, high - inside)
    rows = []
    for value in values:
        start = before

        def cost(q: np.ndarray, value: float = value, start: np.ndarray = start) -> np.ndarray:
            _put(model, mujoco, data, moved, held, value, free, q)
            gaps = [_GAP_WEIGHT * loop.gap(data) for loop in loops]
            return np.concatenate((*gaps, stiffness * (q - rest), _STAY * (q - start)))

        solution = least_squares(cost, start, bounds=(low, high), xtol=1e-12, ftol=1e-12, max_nfev=400)
        before = np.clip(solution.x, low + inside, high - inside)
        rows.append(solution.x)
    return np.array(rows)
