"""The task's one typed configuration. Defaults are the paper's; where it is silent, the docstring says what was chosen.

"Table VIII", "Table IX" and "appendix D" name parts of the X-RESET paper.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Annotated, Any, ClassVar, Literal

from xreset.checks import Checked, Finite, NotNegative, Only, Positive, Range, Share


@dataclass(frozen=True, kw_only=True)
class ActionConfig(Checked):
    """How a policy's output in [-1, 1] becomes joint targets (Table VIII: relative arm commands, absolute hand targets)."""

    arm_step: Positive[float] = 0.03
    """Largest change of an arm joint's target per control step [rad]: 1.8 rad/s at 60 Hz. Not in the paper."""
    arm_lead: Positive[float] = 0.15
    """Farthest that an arm target may run ahead of the joint [rad], so that a blocked arm does not wind up. Not in the paper."""
    hand: Literal["absolute", "relative"] = "absolute"
    """``absolute``: an action says where between its limits a hand joint is to go (the paper). ``relative``: how far its target moves, as
    for the arm, so that a policy that does nothing holds what it was given: with absolute targets a new policy opens the hand in every
    demonstrated grasp and has to learn to hold before it can learn to lift. In-hand manipulation is commonly learned so (Qi et al. 2022,
    In-Hand Object Rotation via Rapid Motor Adaptation)."""
    hand_step: Annotated[Positive[float], Only("hand", "relative")] = 0.05
    """Largest change of a hand joint's target per control step [rad]: 3 rad/s at 60 Hz. Joints that slide move 4 cm
    for every radian."""
    hand_lead: Annotated[Positive[float], Only("hand", "relative")] = 0.4
    """Farthest that a hand joint's target may run ahead of the joint [rad], which is how hard it can press: drives of
    the Sharpa hand reach their effort limits at 0.3 to 0.7."""
    hand_zero: Annotated[Literal["middle", "home"], Only("hand", "absolute")] = "middle"
    """Where a hand joint is sent by action 0: to the middle of its limits, which is a half-closed fist, or to the
    robot's home pose, from which -1 and +1 lead to the limits along two slopes. A new policy's mean is 0: with ``middle`` it closes the
    open hand at once and comes down on the object with its knuckles. Not in the paper."""
    hand_smoothing: Annotated[Positive[Share[float]], Only("hand", "absolute")] = 1.0
    """Share of the new hand target that is taken per control step, in (0, 1]; 1 is the paper's plain target."""


@dataclass(frozen=True, kw_only=True)
class NoiseConfig(Checked):
    """Standard deviations of the observation noise. The paper says what is noisy, not how much."""

    joint_pos: NotNegative[float] = 0.005
    """[rad]"""
    joint_vel: NotNegative[float] = 0.05
    """[rad/s]"""
    object_pos: NotNegative[float] = 0.003
    """[m]"""
    object_rot: NotNegative[float] = 0.02
    """[rad], about a random axis."""
    cloud: NotNegative[float] = 0.002
    """[m], per point."""


@dataclass(frozen=True, kw_only=True)
class ObservationConfig(Checked):
    """What the policy sees (appendix C): groups ``policy``, ``proprio``, ``perception``; the critic's ``privileged``."""

    cloud_points: Positive[int] = 64
    """Points per cloud (P)."""
    cloud: Literal["history", "paired"] = "history"
    """What the policy sees of the object's surface points. ``history``: their positions in the last ``cloud_history`` frames (the draft of
    the paper). ``paired``: for every point its position, its position at the goal, and the goal's minus the present one, in this frame
    only (the published paper): the error of the pose, point by point."""
    cloud_history: Annotated[Positive[int], Only("cloud", "history")] = 5
    """Frames of cloud history, oldest first."""
    rotation: Literal["quaternion", "matrix"] = "quaternion"
    """How orientations are shown: a quaternion with w >= 0, which jumps where w is 0, or the first two columns of the rotation matrix,
    which never do (Zhou et al. 2019, On the Continuity of Rotation Representations)."""
    cloud_scale: Positive[Finite[float]] = 1.0
    """Factor on the clouds' coordinates [1/m]."""
    contact_force_scale: NotNegative[float] = 0.1
    """Factor on fingertip forces [1/N] before they are limited to [-1, 1]."""
    joint_target: bool = False
    """Whether the policy sees how far each drive's target is ahead of its joint [rad]. With absolute hand targets the previous action says
    so; with relative ones nothing does."""
    joint_vel_scale: NotNegative[float] = 0.1
    """Factor on joint velocities [s/rad]."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    @property
    def cloud_shape(self) -> tuple[int, int, int]:
        """Shape of one world's cloud: frames (H), points (P), numbers per point (K)."""
        if self.cloud == "paired":
            return 1, self.cloud_points, 9
        return self.cloud_history, self.cloud_points, 3


@dataclass(frozen=True, kw_only=True)
class RewardConfig(Checked):
    """Weights and widths of the reward (appendix D.d)."""

    reach: Finite[float] = 1.0
    reach_width: Positive[float] = 0.1
    """Distance [m] at which 1 - tanh(d / width) falls to 0.24. Not in the paper."""
    reach_near: Finite[float] = 0.0
    """Weight of a second reach term with its own width. One width cannot do both: 0.1 m pays nothing 36 cm away, where home is, and with
    0.4 m the last centimetres, in which fingers wrap around the object, are worth less than what moving costs."""
    reach_near_width: Positive[float] = 0.05
    """[m]"""
    reach_distance: Literal["best", "present"] = "best"
    """What both reach terms are paid for: the episode's smallest distance so far (the paper), also while the hand moves away again, or the
    present one (as in Isaac Lab's dexterous lift), so that a hand that has missed stays near and tries again."""
    grasp: Finite[float] = 1.0
    tracking: Literal["presence", "progress"] = "presence"
    """What pays for the object's pose while the contact gate is open. ``presence``: how near it is to the goal, in position and in rotation
    (the paper), also of an object that is only pressed down where it stands. ``progress``: how much nearer than at the demonstration's
    start, which pays nothing for that. Isaac Lab came to reward lifting so (isaac-sim/IsaacLab#6155); this form is our own."""
    position: Annotated[Finite[float], Only("tracking", "presence")] = 4.0
    position_width: Annotated[Positive[float], Only("tracking", "presence")] = 0.2
    """[m]"""
    rotation: Annotated[Finite[float], Only("tracking", "presence")] = 4.0
    rotation_shape: Annotated[Literal["tanh", "linear"], Only("tracking", "presence")] = "tanh"
    """How ``rotation`` falls with the angle to the goal. ``tanh``: 1 - tanh(angle / ``rotation_width``) (the paper), which is flat beyond a
    right angle. ``linear``: 1 - angle / pi, which has the same slope everywhere."""
    rotation_width: Annotated[Positive[float], Only("rotation_shape", "tanh")] = 1.5
    """[rad]"""
    rotation_near: Annotated[Finite[float], Only("tracking", "presence")] = 0.0
    """Weight of a second rotation term, 1 - tanh(angle / ``rotation_near_width``), which pays for the last degrees."""
    rotation_near_width: Positive[float] = 0.3
    """[rad]"""
    progress: Annotated[Finite[float], Only("tracking", "progress")] = 8.0
    """Paid in full at the goal, nothing at the start, and less than nothing farther away."""
    progress_width: Annotated[Positive[float], Only("tracking", "progress")] = 0.15
    """[m]"""
    success: Finite[float] = 10.0
    success_position: Positive[float] = 0.02
    """[m] (section V)"""
    success_rotation: Positive[float] = 0.2617993877991494
    """[rad], 15 degrees (section V)"""
    action: Finite[float] = -0.005
    action_rate: Finite[float] = -0.005
    out_of_bounds: Finite[float] = -500.0
    contact: Literal["any", "opposing"] = "any"
    """What opens the gate of ``position``, ``rotation`` and ``success``: thumb and another finger press (the paper), or press against each
    other: their forces on the object are more than 90 degrees apart. A hand that presses an object down from above pushes with both in one
    direction; one that holds it does not. ``grasp`` is paid for either."""
    contact_threshold: NotNegative[float] = 0.1
    """Force [N] from which a finger counts as in contact. Not in the paper."""
    raw_actions: bool = False
    """Whether ``action`` and ``action_rate`` take actions as the policy gave them, and not as limited to [-1, 1]. Where a mean lies beyond
    the limit, noise explores nothing, and only a penalty of the raw action pulls it back (as in Isaac Lab's action terms)."""
    own: dict[str, float] = field(default_factory=dict)
    """Terms of your own: ``module:function`` -> weight (:func:`xreset.task.rewards.own_term`)."""
    scale: Positive[Finite[float]] = 0.01
    """Factor on the total (Table VIII)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, weight in self.own.items():
            if not all(name.partition(":")[::2]) or not isfinite(weight):
                raise ValueError(
                    f"own holds {name!r} with weight {weight}, expected module:function and a finite number"
                )


@dataclass(frozen=True, kw_only=True)
class TerminationConfig(Checked):
    """When an episode ends. The paper names the out-of-bounds termination, not its bounds."""

    episode_seconds: Positive[Finite[float]] = 5.0
    """Time limit [s]; not a failure: its value is bootstrapped."""
    object_low: Finite[float] = -0.05
    """The object is out of bounds when its origin is below this height [m]: it has left the table."""
    object_high: Finite[float] = 1.0
    """... or above this height [m]."""
    margin: Finite[float] = 0.10
    """... or farther than this outside the table's edges [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.object_low < self.object_high:
            raise ValueError(
                f"object_low is {self.object_low}, expected less than object_high, which is {self.object_high}"
            )


@dataclass(frozen=True, kw_only=True)
class ResetConfig(Checked):
    """The reset mixture (sections IV-B, appendix D.c, D.e, Table IX)."""

    REMOVED: ClassVar[dict[str, Any]] = {
        "frontier": 0.0,
        "frontier_over": "bank",
        "frontier_power": 1.0,
        "frontier_rate": 0.1,
    }

    demo_probability: Share[float] = 0.5
    """p: share of resets from the bank; 0 is X-Sim."""
    pre_contact_only: bool = False
    """Use only bank states before first contact."""
    random_gravity: bool = True
    """Bank resets: gravity fraction U(0, 1); False: 1 (the fixed-gravity ablation)."""
    home_gravity_std: NotNegative[float] = 1.0
    """Home resets: standard deviation of the object's gravity [m/s^2] around 9.81; 0 is exactly full gravity."""
    home_gravity_clip: NotNegative[float] = 0.3
    """Home resets: the gravity fraction stays within 1 +- this. The paper clips and does not say where."""
    spawn_xy: NotNegative[float] = 0.02
    """Home resets: the object is moved by U(-x, x) in both directions [m]."""
    spawn_yaw: NotNegative[float] = 0.4363323129985824
    """Home resets: the object is turned about the vertical by U(-y, y) [rad], 25 degrees."""
    home_noise: bool = True
    """Home resets: joints start around home with the robot's ``home_std``."""


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig(Checked):
    """Physical parameters drawn at each reset (Table IX), and what else differs between one robot and the next (not in the paper).

    The second kind is off by default: what a policy loses to it between engines is measured in docs/sim-to-sim.md.
    """

    enabled: bool = True
    friction: Range = (0.5, 1.0)
    """Range of the object material's coefficient."""
    friction_buckets: Positive[int] = 250
    """Number of distinct materials."""
    elastomer: NotNegative[float] = 0.8
    """Coefficient of the fingertips' material. A pair's friction is the mean of its two materials, the rule of the paper's simulator."""
    metal: NotNegative[float] = 0.1
    """Coefficient of every other link's material."""
    table: NotNegative[float] = 0.5
    """Coefficient of the table's material. Not in the paper."""
    mass_scale: Range = (0.7, 1.3)
    """Range of the factor on the object's mass."""
    torsional_friction: Range = (1.0, 1.0)
    """Range of the factor on the torsional friction of the object's pairs."""
    object_inertia: Range = (1.0, 1.0)
    """Range of the factor on the object's inertia, beside what its mass does."""
    object_com: Range = (0.0, 0.0)
    """Range of the distance [m] by which the object's centre of mass is off, in any direction."""
    hand_friction: Range | None = None
    """Range of the coefficient of every link's material beside the fingertips'; None: ``metal``."""
    arm_stiffness: Range = (1.0, 1.0)
    """Range of the factor on the stiffness of the arm's drives, one for all of them; likewise the next four."""
    arm_damping: Range = (1.0, 1.0)
    hand_stiffness: Range = (1.0, 1.0)
    hand_damping: Range = (1.0, 1.0)
    effort: Range = (1.0, 1.0)
    """Of every drive's effort limit."""
    action_latency: Range = (0.0, 0.0)
    """Range of the control steps by which drives hear of an action late; between whole ones the two targets are mixed."""
    observation_latency: Range = (0.0, 0.0)
    """Range of the control steps by which the object's pose and cloud are seen late."""
    force_gain: Range = (1.0, 1.0)
    """Range of the factor on the fingertips' force readings."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("mass_scale", "object_inertia"):
            if not getattr(self, name)[0] > 0:
                raise ValueError(f"{name} begins with {getattr(self, name)[0]}, expected factors above 0")

    def draws(self, *names: str) -> bool:
        """Whether one of these ranges is another than its default."""
        return self.enabled and any(getattr(self, name) != getattr(_AS_STATED, name) for name in names)

    @property
    def scales_drives(self) -> bool:
        """Whether drives differ from what the robot spec says."""
        return self.draws("arm_stiffness", "arm_damping", "hand_stiffness", "hand_damping", "effort")


_AS_STATED = RandomizationConfig()


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Checked):
    """Everything that defines the task apart from robot, objects and reset bank."""

    action: ActionConfig = field(default_factory=ActionConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    reset: ResetConfig = field(default_factory=ResetConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    timestep: Positive[Finite[float]] = 1.0 / 240.0
    """Physics timestep [s]."""
    substeps: Positive[int] = 4
    """Physics steps per control step: control at 60 Hz. Not in the paper."""
    distance_points: Positive[int] = 256
    """Surface points per object for fingertip distances."""

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = self.termination.episode_seconds / (self.timestep * self.substeps)
        for name in ("action_latency", "observation_latency"):
            if (longest := getattr(self.randomization, name)[1]) >= steps:
                raise ValueError(
                    f"{name} goes up to {longest:g} control steps, expected fewer than an episode has, which are {steps:.0f}"
                )


EVALUATION_TIMESTEP = 1.0 / 240.0
"""Physics timestep of evaluations [s], whatever a policy was trained at."""


def evaluation_task(task: TaskConfig) -> TaskConfig:
    """The task as a policy is evaluated: from home at full gravity, nominal physics, no observation noise; spawns stay perturbed.

    Physics takes steps of :data:`EVALUATION_TIMESTEP`, if whole ones make a control step. Reward terms of the user's own are left out: no
    figure rests on them, and their module need not be where a policy is evaluated.
    """
    zero = NoiseConfig(joint_pos=0.0, joint_vel=0.0, object_pos=0.0, object_rot=0.0, cloud=0.0)
    substeps = round(task.timestep * task.substeps / EVALUATION_TIMESTEP)
    if substeps and abs(substeps * EVALUATION_TIMESTEP - task.timestep * task.substeps) < 1e-9:
        task = replace(task, timestep=EVALUATION_TIMESTEP, substeps=substeps)
    return replace(
        task,
        observation=replace(task.observation, noise=zero),
        reward=replace(task.reward, own={}),
        reset=replace(task.reset, demo_probability=0.0, home_gravity_std=0.0),
        randomization=replace(task.randomization, enabled=False),
    )
