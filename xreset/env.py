"""The environment: N worlds of a physics backend, and the task's pure functions around them.

It keeps rsl-rl's vector-environment contract (``step`` resets finished worlds itself) but needs rsl-rl only where a policy is trained. The
same class, with another configuration, runs evaluations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from xreset.objects import surface_points
from xreset.rotations import quat_rotate_inverse
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task import observations as obs
from xreset.task.actions import ActionSpace
from xreset.task.config import TaskConfig
from xreset.task.randomization import sample_friction, sample_mass_scale
from xreset.task.resets import Reset, ResetDistribution
from xreset.task.rewards import Reward, RewardInput, compute_reward
from xreset.task.terminations import episode_steps, out_of_bounds

if TYPE_CHECKING:
    from tensordict import TensorDict

    from xreset.backends.base import Backend, Contacts, Health, Links, State


def make_scene(robot: RobotSpec, objects: tuple[ObjectSpec, ...], task: TaskConfig) -> SceneSpec:
    """The scene that a task is played in."""
    return SceneSpec(robot=robot, objects=objects, timestep=task.timestep, substeps=task.substeps)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What the backend said after a step, and what follows from it."""

    state: State
    links: Links
    contacts: Contacts
    health: Health
    tip_distance: Tensor
    """[N, E] distance from each fingertip to the object's surface points [m]."""


class ManipulationEnv:
    """N worlds in which a robot brings an object to a goal pose.

    All tensors live on the backend's device. World i always holds the same object.

    Attributes:
        num_envs: N.
        num_actions: J.
        max_episode_length: control steps until the time limit.
        episode_length_buf: [N] control steps since each world's reset.
        goal_pos, goal_quat: [N, 3], [N, 4] goal of each world.
        sequence: [N] demonstration of each world.
        gravity_fraction: [N]
        nonfinite_count, overflow_count: [] worlds that were ended because a number was not finite; that dropped contacts.
    """

    def __init__(self, backend: Backend, task: TaskConfig, resets: ResetDistribution, *, seed: int = 0) -> None:
        """Wrap a backend; every world is reset at once.

        Args:
            backend: N worlds.
            task: what to observe, reward and end on.
            resets: where episodes start, on the backend's device.
            seed: of every random number that the environment draws.
        """
        self.backend, self.task, self.resets = backend, task, resets
        self.cfg = task
        self.device = backend.device
        scene = backend.scene
        n = self.num_envs = backend.num_worlds
        self.num_actions = len(scene.robot.joints)
        self.max_episode_length = episode_steps(task.termination, scene.control_dt)
        self.generator = torch.Generator(device=self.device)
        self.generator.manual_seed(seed)
        self.actions = ActionSpace.of(scene.robot, task.action, self.device)

        def per_object(count: int) -> Tensor:
            points = [torch.as_tensor(surface_points(o, count), dtype=torch.float32) for o in scene.objects]
            return torch.stack(points).to(self.device)[backend.object_index]

        self._cloud_points = per_object(task.observation.cloud_points)
        self._surface_points = per_object(task.distance_points)
        self._nominal_mass = torch.tensor([o.mass for o in scene.objects], device=self.device)[backend.object_index]
        self._limits = tuple(
            torch.where(limit.isfinite(), limit, sign * torch.pi) for limit, sign in ((self.actions.lower, -1.0), (self.actions.upper, 1.0))
        )

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=self.device)

        self.episode_length_buf = zeros(dtype=torch.long)
        self.goal_pos, self.goal_quat = zeros(3), zeros(4)
        self.gravity_fraction, self.sequence = zeros(), zeros(dtype=torch.long)
        self.from_bank = zeros(dtype=torch.bool)
        self.nonfinite_count, self.overflow_count = zeros(dtype=torch.long).sum(), zeros(dtype=torch.long).sum()
        self._target, self._previous_action = zeros(self.num_actions), zeros(self.num_actions)
        self._best_reach, self._reward = zeros(), zeros()
        self._cloud = zeros(task.observation.cloud_history, task.observation.cloud_points, 3)
        self._episode_terms: dict[str, Tensor] = {}
        self.reset()

    # rsl-rl's contract -------------------------------------------------------------------------------------------------------------

    def get_observations(self) -> TensorDict:
        """Observations of the present state, by group."""
        return self._observations

    def step(self, action: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step, then a reset of every world whose episode has ended.

        Args:
            action: [N, J] in [-1, 1] (limited to it).

        Returns:
            Observations (of the new episode where one has begun), reward [N], done [N] (0 or 1), extras with ``time_outs`` [N] (ended
            without failing: the value is to be bootstrapped) and ``log``.
        """
        reading, reward, failed, time_out = self._advance(action)
        done = failed | time_out
        log = self._log(reward, done, sound=~reading.health.nonfinite)
        finished = done.nonzero().squeeze(-1)
        if len(finished):
            self.reset(finished)
        else:
            self._observe(reading)
        return self._observations, self._last_reward, done.long(), {"time_outs": time_out.float(), "log": log}

    # Stepping and resetting --------------------------------------------------------------------------------------------------------

    def advance(self, action: Tensor) -> tuple[Reading, Reward]:
        """One control step without any reset: for evaluation, which ends episodes by itself."""
        reading, reward, _, _ = self._advance(action)
        self._observe(reading)
        return reading, reward

    def reset(self, worlds: Tensor | None = None, start: Reset | None = None) -> None:
        """Start new episodes.

        Args:
            worlds: [M] long indices; None means all.
            start: the M starts; None draws them from the reset distribution.
        """
        if worlds is None:
            worlds = torch.arange(self.num_envs, device=self.device)
        if start is None:
            start = self.resets.sample(self.backend.object_index[worlds], self.generator)
        backend, m = self.backend, len(worlds)
        friction = sample_friction(m, self.task.randomization, self.generator)
        mass = self._nominal_mass[worlds] * sample_mass_scale(m, self.task.randomization, self.generator)
        backend.set_friction(friction, worlds)
        backend.set_object_mass(mass, worlds)
        backend.set_object_gravity(start.gravity_fraction, worlds)
        backend.set_state(rest_state(start.joint_pos, start.object_pos, start.object_quat), worlds)
        self.goal_pos[worlds], self.goal_quat[worlds] = start.goal_pos, start.goal_quat
        self.gravity_fraction[worlds], self.sequence[worlds] = start.gravity_fraction, start.sequence
        self.from_bank[worlds] = start.from_bank
        self.episode_length_buf[worlds] = 0
        self._target[worlds] = start.joint_pos
        self._previous_action[worlds] = 0.0
        self._reward[worlds] = 0.0
        reading = self._read()
        self._best_reach[worlds] = reading.tip_distance.mean(dim=-1)[worlds]
        self._observe(reading, fresh=worlds)

    def reading(self) -> Reading:
        """The present physical state and what follows from it."""
        return self._read()

    @property
    def joint_target(self) -> Tensor:
        """[N, J] present drive targets."""
        return self._target

    def rng_state(self) -> Tensor:
        """State of the random numbers, for a checkpoint."""
        return self.generator.get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Continue with the random numbers of a checkpoint."""
        self.generator.set_state(state.cpu())

    # Parts -------------------------------------------------------------------------------------------------------------------------

    def _advance(self, action: Tensor) -> tuple[Reading, Reward, Tensor, Tensor]:
        action = action.clamp(-1.0, 1.0)
        self._target = self.actions.targets(action, self._target, self._joint_pos)
        self.backend.set_joint_targets(self._target)
        self.backend.step()
        reading = self._read()
        # The worlds that broke say nothing true any more: they end, teach nothing (reward 0, bootstrapped like a time-out) and are counted.
        broken = reading.health.nonfinite
        self.nonfinite_count += broken.sum()
        self.overflow_count += reading.health.overflow.sum()
        lost = out_of_bounds(reading.state.object_pos, self.backend.scene.table, self.task.termination) & ~broken
        reach = reading.tip_distance.mean(dim=-1)
        self._best_reach = torch.where(broken, self._best_reach, torch.minimum(self._best_reach, reach))
        reward = compute_reward(
            RewardInput(
                tip_distance=reading.tip_distance,
                best_reach=self._best_reach,
                tip_force=reading.contacts.tip_force.norm(dim=-1),
                object_pos=reading.state.object_pos,
                object_quat=reading.state.object_quat,
                goal_pos=self.goal_pos,
                goal_quat=self.goal_quat,
                action=action,
                previous_action=self._previous_action,
                out_of_bounds=lost,
            ),
            self.task.reward,
        )
        self._last_reward = torch.where(broken, 0.0, reward.total)
        self._reward = self._last_reward.clone()
        self._previous_action = action
        self.episode_length_buf += 1
        time_out = (self.episode_length_buf >= self.max_episode_length) | broken
        return reading, reward, lost, time_out & ~lost

    def _read(self) -> Reading:
        state, links = self.backend.state(), self.backend.links()
        local = quat_rotate_inverse(state.object_quat[:, None], links.pos[:, 1:] - state.object_pos[:, None])
        self._joint_pos = state.joint_pos
        return Reading(
            state=state,
            links=links,
            contacts=self.backend.contacts(),
            health=self.backend.health(),
            tip_distance=torch.cdist(local, self._surface_points).amin(dim=-1),
        )

    def _observe(self, reading: Reading, fresh: Tensor | None = None) -> None:
        """Refresh the observations; worlds in ``fresh`` [M] have just been reset and start with a history of copies."""
        from tensordict import TensorDict

        c, state, links = self.task.observation, reading.state, reading.links
        x = obs.ObservationInput(
            joint_pos=state.joint_pos,
            joint_vel=state.joint_vel,
            joint_lower=self._limits[0],
            joint_upper=self._limits[1],
            object_pos=state.object_pos,
            object_quat=state.object_quat,
            object_linvel=state.object_linvel,
            object_angvel=state.object_angvel,
            goal_pos=self.goal_pos,
            goal_quat=self.goal_quat,
            gravity_fraction=self.gravity_fraction,
            previous_action=self._previous_action,
            palm_pos=links.pos[:, 0],
            palm_quat=links.quat[:, 0],
            palm_linvel=links.linvel[:, 0],
            palm_angvel=links.angvel[:, 0],
            tip_pos=links.pos[:, 1:],
            tip_force=reading.contacts.tip_force,
            tip_distance=reading.tip_distance,
            reward=self._reward,
        )
        frame = obs.cloud_frame(self._cloud_points, state.object_pos, state.object_quat, c.noise.cloud, self.generator)
        self._cloud = torch.cat((self._cloud[:, 1:], frame[:, None]), dim=1)
        if fresh is not None:
            self._cloud[fresh] = frame[fresh, None]
        groups = {
            "policy": obs.policy_group(x, c.noise, self.generator),
            "proprio": obs.proprio_group(x, c, self.generator),
            "perception": self._cloud,
            "privileged": obs.privileged_group(x),
        }
        self._observations = TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def _log(self, reward: Reward, done: Tensor, sound: Tensor) -> dict[str, Tensor]:
        """Means over worlds of this step, by name; scalars on the device, so that nothing waits for them.

        Reward terms are means over the worlds that are ``sound`` [N]: the others' say nothing, and are counted.
        """
        log = {f"reward/{name}": _mean_where(value, sound) for name, value in reward.terms.items()}
        log |= {
            "task/grasped": reward.grasped.float().mean(),
            "task/success": reward.success.float().mean(),
            "task/grasped_from_home": _mean_where(reward.grasped, ~self.from_bank),
            "task/success_from_home": _mean_where(reward.success, ~self.from_bank),
            "episode/ended": done.float().mean(),
            "health/nonfinite_total": self.nonfinite_count.float(),
            "health/overflow_total": self.overflow_count.float(),
        }
        return log


def rest_state(joint_pos: Tensor, object_pos: Tensor, object_quat: Tensor) -> State:
    """A state at rest whose drives hold the given joint positions [M, J]."""
    from xreset.backends.base import State

    zero = torch.zeros_like(object_pos)
    return State(
        joint_pos=joint_pos,
        joint_vel=torch.zeros_like(joint_pos),
        joint_target=joint_pos,
        object_pos=object_pos,
        object_quat=object_quat,
        object_linvel=zero,
        object_angvel=zero,
    )


def _mean_where(values: Tensor, mask: Tensor) -> Tensor:
    """[] mean of numbers or bools [N] over the worlds of a mask; 0 if there are none."""
    return torch.where(mask, values, 0).sum() / mask.sum().clamp_min(1)


__all__ = ["ManipulationEnv", "Reading", "make_scene", "rest_state"]
