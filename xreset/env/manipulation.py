"""The environment: N worlds of a physics backend, and the task's pure functions around them.

A step turns actions into joint targets, advances the physics, computes rewards and ends of episodes, resets the worlds
whose episode has ended, and computes observations.

The environment has rsl-rl's interface of vector environments (``step`` resets finished worlds itself), but only
training needs rsl-rl. Evaluations use the same class with another configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from xreset.errors import XResetError
from xreset.files.checks import PositiveInt, Seed, obeys_rules
from xreset.files.text import shown
from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.objects.sampling import center, metric_points, surface_normals, surface_points
from xreset.physics import Backend, Parameters, State
from xreset.physics.capture import GraphRunner
from xreset.physics.plugins import make_backend
from xreset.physics.tensors import where
from xreset.resets.bank import ResetBank, check_states
from xreset.resets.distribution import Reset, ResetDistribution
from xreset.resets.schedule import shared_worlds
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec, checked_objects
from xreset.task import observations as obs
from xreset.task.actions import ActionSpace
from xreset.task.config import TaskConfig
from xreset.task.default import TASK
from xreset.task.reading import Reading, step_log
from xreset.task.rewards import Reward, RewardFunction, RewardInput
from xreset.task.slots import Slots
from xreset.task.terminations import out_of_bounds
from xreset.task.variation import Variation
from xreset.task.worlds import Worlds

if TYPE_CHECKING:
    from tensordict import TensorDict

    from xreset.pictures.render import Renderer
    from xreset.task.vision import Vision


def _check_shape(name: str, value: Tensor, expected: tuple[int, ...]) -> None:
    if not isinstance(value, Tensor):
        raise XResetError(
            f"{name} is a {type(value).__name__}, expected a tensor: torch.as_tensor({name})."
        )
    if value.shape != expected:
        raise XResetError(f"{name} has the shape {tuple(value.shape)}, expected {expected}.")


def make_scene(robot: RobotSpec, objects: tuple[ObjectSpec, ...], task: TaskConfig) -> SceneSpec:
    """Return the scene that a task is played in."""
    return SceneSpec(robot=robot, objects=objects, timestep=task.timestep, substeps=task.substeps)


@obeys_rules
def make_env(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    bank: ResetBank,
    task: TaskConfig | None = None,
    *,
    engine: str = "mujoco",
    num_envs: PositiveInt = 16,
    device: str = "cpu",
    seed: Seed = 0,
) -> ManipulationEnv:
    """Make N worlds of the task in an engine. Close the environment, or use it as a context manager.

    Args:
        robot: the robot of the bank.
        objects: the objects of the bank; world i holds object i modulo their number, unless
            ``task.reset.object_share`` gives some objects more worlds.
        bank: where episodes begin, and their goals.
        task: observations, rewards and ends of episodes; default: those of ``xreset train``.
        engine: name of the engine, as ``xreset engines`` prints it.
        num_envs: N.
        device: where the engine and all tensors live.
        seed: seed of every random number that the environment draws.

    Raises:
        FileFormatError: the bank's states are for another robot or other meshes.
        DemoError: the bank has no demonstration of an object.
        XResetError: ``task.reset.object_share`` names an unknown object, or an object gets no world.
    """
    task = task or TASK
    objects = checked_objects(robot, objects)
    check_states(bank, robot, objects)
    scene = make_scene(robot, objects, task)
    object_index = None
    if share := task.reset.object_share:
        object_index = torch.as_tensor(shared_worlds([o.name for o in objects], num_envs, share))
    backend = make_backend(engine, scene, num_envs, object_index=object_index, device=device)
    try:
        resets = ResetDistribution.of(bank, robot, objects, task, backend.device)
        return ManipulationEnv(backend, task, resets, seed=seed)
    except BaseException:
        backend.close()
        raise


class ManipulationEnv:
    """N worlds in which a robot brings an object to a goal pose.

    All tensors live on the backend's device. World i always holds the same object. Apart from physics, a step is a few
    functions over fixed buffers that never branch on a world's state, so that a GPU replays them as graphs.

    Attributes:
        num_envs: N.
        num_actions: J, or the slots of a policy for several robots (``task.joint_slots``).
        max_episode_length: control steps until the time limit.
        goal_pos: [N, 3] goal position of each world, world frame [m].
        goal_quat: [N, 4] goal orientation of each world.
        start_quat: [N, 4] object orientation with which each world's episode began.
        sequence: [N] demonstration of each world.
        bank_state: [N] bank state that each world's episode began with, -1 for home.
        gravity_fraction: [N] share of the object's weight that acts.
        nonfinite_count: [] number of episodes that ended because a number was not finite.
        overflow_count: [] number of episodes that ended because the engine dropped contacts.
        worlds: everything that lasts from step to step, in addition to the engine's state.
        variation: differences between the worlds, such as masses and delays.
        tracked_pose: position [N, 3] and orientation [N, 4] of the object, as the tracker reports them in this step.
        vision: the cameras; None: the task has none.
        slots: slots of the robot's joints and fingertips; None: the task has none.
    """

    def __init__(
        self, backend: Backend, task: TaskConfig, resets: ResetDistribution, *, seed: int = 0
    ) -> None:
        """Wrap a backend and reset every world.

        Args:
            backend: the worlds.
            task: observations, rewards and ends of episodes.
            resets: where episodes start, on the backend's device.
            seed: seed of every random number that the environment draws.
        """
        self.backend = backend
        self.task = task
        self._reward_function = RewardFunction(task.reward)
        self.slots = Slots.of(backend.scene.robot, task.joint_slots, backend.device)
        self._observer = obs.Observer(task.observation, self.slots)
        self.resets = resets
        self.cfg = task  # rsl-rl's name of the configuration
        self.device = backend.device
        scene = backend.scene
        self.num_envs = backend.num_worlds
        robot = scene.robot
        self.num_actions, _ = task.sizes(len(robot.joints), len(robot.fingertips))
        steps = round(task.termination.episode_seconds / scene.control_dt)
        self.max_episode_length = max(1, steps)
        self.generator = torch.Generator(device=self.device)
        self.generator.manual_seed(seed)
        self._graphs = GraphRunner(self.device, self.generator)
        self.actions = ActionSpace(scene.robot, task.action, self.device)

        def of_worlds(function: Callable[[ObjectSpec], np.ndarray]) -> Tensor:
            """[N, ...] value of the function for each world's object."""
            values = [torch.as_tensor(function(o), dtype=torch.float32) for o in scene.objects]
            return torch.stack(values).to(self.device)[backend.object_index]

        count = task.observation.cloud_points
        self._cloud_points = of_worlds(lambda o: surface_points(o, count))
        self._cloud_normals = of_worlds(lambda o: surface_normals(o, count))
        self._surface_points = of_worlds(lambda o: surface_points(o, task.distance_points))
        self._metric_points = of_worlds(metric_points)
        self._center = None
        if task.object_frame == "center":
            self._center = of_worlds(center)
            self._cloud_points = self._cloud_points - self._center[:, None]
            self._metric_points = self._metric_points - self._center[:, None]
        self._joint_lower = self.actions.lower.nan_to_num(neginf=-torch.pi)
        self._joint_upper = self.actions.upper.nan_to_num(posinf=torch.pi)
        self._renderer: Renderer | None = None
        self._allocate()
        self.reset()

    def __repr__(self) -> str:
        robot = self.backend.scene.robot.name
        return f"ManipulationEnv(num_envs={self.num_envs}, robot={robot!r}, engine={self.backend.name!r})"

    def _allocate(self) -> None:
        """Make every buffer that a step writes to."""
        from tensordict import TensorDict

        self.worlds = Worlds(self.num_envs, self.device)
        keep = self.worlds.keep
        zeros = self.worlds.zeros
        robot = self.backend.scene.robot
        joints = len(robot.joints)
        no_world = zeros().bool()
        # Only the shapes of this draw are used. Another generator draws it, so that episodes do not depend on it.
        unused = torch.Generator(device=self.device)
        self._new_start = self.resets.sample(self.backend.object_index, unused).clone()
        # How each world's episode began, and its present joint targets. Resets write into these tensors.
        self._episode = self.worlds.keep_bundle("episode", self._new_start.clone())
        self.goal_pos = self._episode.goal_pos
        self.goal_quat = self._episode.goal_quat
        self.start_quat = self._episode.object_quat
        self.gravity_fraction = self._episode.gravity_fraction
        self.sequence = self._episode.sequence
        self.bank_state = self._episode.state
        self._target = self._episode.joint_target
        self._episode_length = keep("episode_length", zeros().long())
        self._previous_action = keep("previous_action", zeros(joints))
        self._best_reach = keep("best_reach", zeros())
        """[N] smallest mean distance of the fingertips to the object in the episode [m]."""
        self._reward = keep("reward", zeros())
        self.tracked_pose = (keep("tracked_pos", zeros(3)), keep("tracked_quat", zeros(4)))
        self._cloud = keep("cloud", zeros(*obs.cloud_shape(self.task.observation)))
        self._bad_action = keep("bad_action", no_world.clone())
        """[N] bool: an action of the episode was not finite."""
        self._over = keep("over", no_world.clone())
        """[N] bool: the episode is over, and the world waits for its reset."""
        self._is_cut = keep("is_cut", no_world.clone())
        """[N] bool: the episode has less time than others, because its length was assigned."""
        self.nonfinite_count = torch.zeros((), dtype=torch.long, device=self.device)
        self.overflow_count = self.nonfinite_count.clone()
        # What follows is written anew in each step.
        self._action = zeros(joints)
        self._sent_target = zeros(joints)
        """[N, J] joint targets that reach the drives: late, lost or pushed (``variation``)."""
        self._time_out = no_world.clone()
        """[N] bool: the episode ends now, and not because the object is out of bounds."""
        self._faulty = no_world.clone()
        """[N] bool: the simulation failed in this step."""
        self._reset_mask = no_world.clone()
        """[N] bool: the world is reset now, or its episode has just begun."""
        task = self.task
        sizes = task.sizes(joints, len(robot.fingertips))
        layout = obs.layout(*sizes, task.observation)
        width = sum(layout["proprio"].values())
        self.variation = Variation(
            self.worlds, self.backend, task.randomization, self.actions.is_arm, width
        )
        self.vision: Vision | None = None
        if task.vision.cameras:
            from xreset.task.vision import Vision  # Warp, which other tasks do not need

            self.vision = Vision(self.worlds, self.backend, task)
        self._log_names: tuple[str, ...] = ()
        self._log_values = torch.zeros(0, device=self.device)
        self._observations = TensorDict({}, batch_size=[self.num_envs], device=self.device)

    def close(self) -> None:
        """Close the engine."""
        self.backend.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # rsl-rl's interface

    @property
    def episode_length_buf(self) -> Tensor:
        """[N] control steps since each world's reset. Assigned values are copied into the buffer; an episode that they
        cut short is no try of its demonstration."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length.copy_(value)
        self._is_cut.copy_(value > 0)

    @property
    def from_bank(self) -> Tensor:
        """[N] bool: whether each world's episode began with a bank state."""
        return self.bank_state >= 0

    def get_observations(self) -> TensorDict:
        """Observations of the present state, by group."""
        return self._observations.clone()

    def step(
        self, action: Tensor, begin: Tensor | None = None
    ) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Take one control step, then reset every world whose episode has ended.

        Args:
            action: [N, J], limited to [-1, 1]. A world whose numbers are not finite ends as if its engine had failed.
            begin: [N] bool, worlds to reset; None: the worlds whose episode has ended. A world whose episode has ended
                does not end again before it is reset.

        Returns:
            Observations (of the new episode where one has begun), reward [N], done [N] (0 or 1), and a dictionary with
            ``time_outs`` [N] (the episode ended without failing: bootstrap its value), ``faulty`` [N] bool (the
            simulation failed: learn nothing from this step) and ``log``.

        Raises:
            XResetError: action or begin is not a tensor, or has another shape.
        """
        if begin is not None:
            _check_shape("begin", begin, (self.num_envs,))
        self._apply_action(action)
        self._graphs.run(self._compute_rewards)
        reward = self._reward.clone()
        done = self._reset_mask.long()
        extras = {
            "time_outs": self._time_out.float(),
            "faulty": self._faulty.clone(),
            "log": dict(zip(self._log_names, self._log_values.clone().unbind(), strict=True)),
        }
        if begin is not None:
            self._over |= self._reset_mask
            self._reset_mask.copy_(begin)
        # a GPU would have to be waited for to learn whether there is a world to reset
        if self._graphs.active or self._reset_mask.any():
            self._graphs.run(self._sample_resets)
            self._write_resets()
        self._take_images()
        self._graphs.run(self._compute_observations)
        return self.get_observations(), reward, done, extras

    # Stepping and resetting

    def advance(self, action: Tensor, push: Tensor | None = None) -> tuple[Reading, Reward]:
        """Take one control step without any reset. Evaluations end episodes themselves.

        Args:
            action: [N, J], limited to [-1, 1].
            push: [N, J] offset of the drives' targets [rad, m]: an external torque, divided by the drive's stiffness.

        Raises:
            XResetError: action or push is not a tensor, or has another shape.
        """
        if push is not None:
            _check_shape("push", push, tuple(self._action.shape))
        self._apply_action(action, push)
        reading, reward = self._compute_rewards()
        self._reset_mask.zero_()
        self._take_images()
        self._compute_observations()
        return reading, reward

    def reset(
        self,
        worlds: Tensor | None = None,
        start: Reset | None = None,
        seeds: Sequence[Sequence[int]] | None = None,
    ) -> None:
        """Start new episodes. The other worlds and their observations stay as they are.

        Args:
            worlds: [M] long indices of worlds; None: all worlds.
            start: M starts; None: they are drawn from the reset distribution.
            seeds: seed of each world, for :meth:`Worlds.redirect`; None: directions are drawn like everything else.

        Raises:
            XResetError: there is no such world.
        """
        if worlds is None:
            worlds = torch.arange(self.num_envs, device=self.device)
        index = torch.as_tensor(worlds, device=self.device)
        self._reset_mask.zero_()
        try:
            if (index < 0).any():
                raise IndexError("torch counts negative indices from the end")
            self._reset_mask[index] = True
        except IndexError as error:
            raise XResetError(
                f"worlds is {shown(worlds)}, expected indices from 0 to {self.num_envs - 1}."
            ) from error
        if start is not None:
            self._new_start[index] = start
        before = self.worlds.clone()
        self._sample_resets(start is None)
        if seeds is not None:
            self.worlds.redirect(seeds)
        self._write_resets()
        self._take_images()
        self._compute_observations()
        # all worlds were observed, and those that go on have their own observations
        self.worlds.copy(before, ~self._reset_mask)

    # The present state

    def reading(self) -> Reading:
        """Return the present physical state and what follows from it."""
        return Reading.of(self.backend, self._surface_points, self._bad_action, self._center)

    @property
    def joint_target(self) -> Tensor:
        """[N, J] joint targets of the last action, before their delay on the way to the drives."""
        return self._target

    @property
    def task_goal_pos(self) -> Tensor:
        """[N, 3] goal position of the object's origin in the task (``TaskConfig.object_frame``)."""
        return self._task_origin(self.goal_pos, self.goal_quat)

    def render(self, world: int = 0, size: tuple[int, int] = (640, 480)) -> np.ndarray:
        """Return a picture of one world, [H, W, 3] uint8, with the goal as a translucent object.

        Args:
            world: index of the world.
            size: width and height in pixels.

        Raises:
            XResetError: there is no such world.
        """
        if not 0 <= world < self.num_envs:
            raise XResetError(f"world is {world}, expected one from 0 to {self.num_envs - 1}.")
        # trimesh, which training does not need
        from xreset.pictures.render import Renderer

        if self._renderer is None or self._renderer.size != size:
            self._renderer = Renderer(self.backend.scene, size=size)
        state = self.backend.state()[world].to("cpu")
        return self._renderer.draw(
            state.joint_pos.numpy(),
            (state.object_pos.numpy(), state.object_quat.numpy()),
            goal_pose=(self.goal_pos[world].cpu().numpy(), self.goal_quat[world].cpu().numpy()),
            object_index=int(self.backend.object_index[world]),
        )

    # Parts

    def _task_origin(self, pos: Tensor, quat: Tensor) -> Tensor:
        """Return positions [N, 3] of the object's origin in the task, given poses of its mesh frame."""
        return pos if self._center is None else pos + quat_rotate(quat, self._center)

    def _apply_action(self, action: Tensor, push: Tensor | None = None) -> None:
        """Step the physics with an action; arguments as for :meth:`advance`."""
        _check_shape("action", action, (self.num_envs, self.num_actions))
        if self.slots is not None:
            action = action[:, self.slots.of_joint]
        self._action.copy_(action.detach())
        self._graphs.run(self._process_action)
        target = self._sent_target if push is None else self._sent_target + push
        self.backend.set_joint_targets(target)
        pushes = self.variation.pushes
        if pushes is not None and pushes.config.moves_object:
            self.backend.set_object_wrench(pushes.force, pushes.torque)
        self.backend.step()

    def _process_action(self) -> None:
        """Turn the action into the drives' targets."""
        state = self.backend.state()
        self._bad_action |= ~self._action.isfinite().all(dim=1)
        self._action.nan_to_num_(0.0, 0.0, 0.0)
        target = self.actions.targets(self._action, self._target, state.joint_pos)
        self._target.copy_(self.variation.received_targets(target, self._target, self.generator))
        self._sent_target.copy_(self.variation.sent_targets(self._target, state, self.generator))

    def _compute_rewards(self) -> tuple[Reading, Reward]:
        """Read the worlds after a step, and compute rewards, ends of episodes and the numbers to log."""
        reading = self.reading()
        broken = reading.health.nonfinite
        self._mark_faults(reading)
        lost = ~broken & out_of_bounds(reading.task_state.object_pos, self.backend.scene.table)
        reach = reading.tip_distance.mean(dim=-1)
        self._best_reach.copy_(
            torch.where(broken, self._best_reach, torch.minimum(self._best_reach, reach))
        )
        reward = self._reward_function(self._reward_input(reading, lost))
        self._reward.copy_(torch.where(broken, 0.0, reward.total))
        if self.variation.pushes is not None:
            self.variation.pushes.gate.copy_(reward.gate & ~broken)
        self._previous_action.copy_(self._action)
        self._end_episodes(lost, reward.success)
        self._log_step(reward, ~broken)
        return reading, reward

    def _end_episodes(self, lost: Tensor, success: Tensor) -> None:
        """Count the step, and mark the worlds whose episode ends now: out of bounds, out of time, or with a failed
        simulation. An episode ends once, also if the world has to wait for its reset.

        Args:
            lost: [N] bool, worlds that are out of bounds.
            success: [N] bool, worlds whose object is at its goal.
        """
        self._episode_length += 1
        time_out = (self._episode_length >= self.max_episode_length) | self._faulty
        self._time_out.copy_(time_out & ~lost)
        self._reset_mask.copy_((lost | time_out) & ~self._over)
        if self.resets.config.adaptive_share:
            ended = self._reset_mask & ~self.from_bank & ~self._faulty & ~self._is_cut
            self.resets.record(self.sequence, success, ended)

    def _mark_faults(self, reading: Reading) -> None:
        """Mark and count the worlds whose simulation failed in an episode that is not over. Training ignores them."""
        broken = reading.health.nonfinite
        self._faulty.copy_((broken | reading.health.overflow) & ~self._over)
        self.nonfinite_count += (self._faulty & broken).sum()
        self.overflow_count += (self._faulty & ~broken).sum()

    def _log_step(self, reward: Reward, sound: Tensor) -> None:
        """Keep the names and values of this step's log; ``sound`` [N] bool marks worlds that have not failed."""
        totals = {
            "health/nonfinite_total": self.nonfinite_count,
            "health/overflow_total": self.overflow_count,
        }
        names, values = step_log(
            reward, self._reset_mask, sound=sound, from_home=~self.from_bank, totals=totals
        )
        if not self._log_names:
            self._log_names = names
            self._log_values = torch.zeros_like(values)
        self._log_values.copy_(values)

    def _reward_input(self, reading: Reading, lost: Tensor) -> RewardInput:
        """Return what the reward is computed from; ``lost`` [N] bool marks the worlds that are out of bounds."""
        start_pos, start_quat = self.resets.start_pose(self.sequence)
        return RewardInput(
            tip_distance=reading.tip_distance,
            best_reach=self._best_reach.clone(),
            tip_force=reading.contacts.tip_force,
            state=reading.task_state,
            goal_pos=self.task_goal_pos,
            goal_quat=self.goal_quat,
            start_pos=self._task_origin(start_pos, start_quat),
            start_quat=start_quat,
            action=self._action,
            previous_action=self._previous_action,
            out_of_bounds=lost,
            palm_distance=self._palm_distance(reading),
            points=self._metric_points,
            is_arm=self.actions.is_arm,
            success_position=self.task.reward.success_position,
        )

    def _palm_distance(self, reading: Reading) -> Tensor:
        """[N] distance from the palm to the object's surface points [m]."""
        state = reading.state
        palm = quat_rotate_inverse(state.object_quat, reading.links.pos[:, 0] - state.object_pos)
        return (self._surface_points - palm[:, None]).norm(dim=-1).amin(dim=-1)

    def _sample_resets(self, from_distribution: bool = True) -> None:
        """Draw new starts for the worlds to reset. All worlds draw, so that no GPU waits for the number of resets."""
        fresh = self._reset_mask
        start = self._new_start
        if from_distribution:
            start.map(Tensor.copy_, self.resets.sample(self.backend.object_index, self.generator))
        self.variation.begin_episodes(fresh, start.joint_target)
        self.worlds.draw(fresh, self.generator)
        self._episode.map(Tensor.copy_, where(fresh, start, self._episode))
        self._previous_action.masked_fill_(fresh[:, None], 0)
        for cleared in (self._episode_length, self._reward, self._over, self._is_cut):
            cleared.masked_fill_(fresh, 0)

    def _write_resets(self) -> None:
        """Put the worlds to reset into their new states."""
        start = self._new_start
        self._bad_action &= ~self._reset_mask
        self.backend.set_where(
            self._reset_mask,
            State.at_rest(start.joint_pos, start.object_pos, start.object_quat, start.joint_target),
            Parameters(**self.variation.parameters, object_gravity=self.gravity_fraction),
        )

    def _take_images(self) -> None:
        """Let the cameras take their images."""
        if self.vision is not None:
            self._graphs.run(self._aim_cameras)
            self.vision.cameras.cast()

    def _aim_cameras(self) -> None:
        if self.vision is not None:
            self.vision.aim(
                self.backend.state(), self.goal_pos, self.goal_quat, self._episode_length
            )

    def _compute_observations(self) -> None:
        """Refresh the observations. In fresh worlds the present cloud and reach become the whole history."""
        reading = self.reading()
        self._best_reach.copy_(
            torch.where(self._reset_mask, reading.tip_distance.mean(dim=-1), self._best_reach)
        )
        x = self._observation_input(reading)
        observed = self._observer.group
        proprio, links = self.variation.observed_proprio(
            observed("proprio", x), x.links, self._reset_mask
        )
        seen = replace(x, links=links)  # by the policy; the critic knows where the links are
        cloud = observed("perception", seen)
        history = torch.cat((self._cloud[:, 1:], cloud[:, -1:]), dim=1)
        self._cloud.copy_(where(self._reset_mask, cloud, history))
        groups = {
            "policy": observed("policy", seen),
            "proprio": proprio,
            "perception": self._cloud,
            "privileged": observed("privileged", x),
        }
        if self.slots is not None:
            groups["action_mask"] = self.slots.mask.expand(self.num_envs, -1)
        if self.vision is not None:
            groups["goal"] = observed("goal", x)
            groups["view"] = self.vision.observe(self._reset_mask, self.generator)
        for name, value in groups.items():
            if name not in self._observations:
                buffer = torch.zeros_like(value)
                self._observations[name] = self.worlds.keep(f"observations.{name}", buffer)
            self._observations[name].copy_(value)

    def _observation_input(self, reading: Reading) -> obs.ObservationInput:
        """Return what observations are made of; the tracker observes the object."""
        state = reading.task_state
        observed_pos, observed_quat = self.variation.tracker.observe(
            state.object_pos, state.object_quat, self._reset_mask, self.generator
        )
        for kept, value in zip(self.tracked_pose, (observed_pos, observed_quat), strict=True):
            kept.copy_(value)
        return obs.ObservationInput(
            state=state,
            links=reading.links,
            joint_target=self._target,
            joint_lower=self._joint_lower,
            joint_upper=self._joint_upper,
            points=self._cloud_points,
            normals=self._cloud_normals,
            observed_pos=observed_pos,
            observed_quat=observed_quat,
            goal_pos=self.task_goal_pos,
            goal_quat=self.goal_quat,
            start_quat=self.start_quat,
            gravity_fraction=self.gravity_fraction,
            previous_action=self._previous_action.clamp(-1.0, 1.0),
            tip_force=reading.contacts.tip_force * self.variation.force_gain,
            tip_distance=reading.tip_distance,
            reward=self._reward,
            generator=self.generator,
        )


def checked_env(env: ManipulationEnv) -> ManipulationEnv:
    """Return an environment; ``XResetError`` if it is something else."""
    if not isinstance(env, ManipulationEnv):
        raise XResetError(f"env is {shown(env)}, expected an environment: xreset.make_env(...).")
    return env
