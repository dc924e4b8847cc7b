"""The task's typed configuration. Defaults are the paper's; where the paper is silent, the docstring says so.

"Table VIII", "Table IX" and "appendix D" name parts of the X-RESET paper.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import field, replace
from math import isfinite
from typing import Annotated, Any, Literal

from xreset.cameras.config import VisionConfig
from xreset.errors import WrongValueError, XResetError
from xreset.files.checks import (
    Checked,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Range,
    Rule,
    Share,
    frozen,
)
from xreset.files.text import shown
from xreset.spec import FINGERS
from xreset.task.legacy import ObservationOptions, RewardOptions
from xreset.task.terms import Named, OneTerm, Terms

LONGEST_EPISODE = 1e6
"""Longest episode [s]: the largest time that a file of traces may hold."""

PositiveRange = Annotated[Range, Rule("factors above 0", lambda x: x[0] > 0)]


def _are_shares(shares: dict[str, float]) -> bool:
    return isinstance(shares, dict) and all(
        isinstance(name, str) and isfinite(share) and share > 0 for name, share in shares.items()
    )


@frozen
class ActionConfig(Checked):
    """How a policy's output in [-1, 1] becomes joint targets.

    In the paper, arm commands are relative and hand targets absolute (Table VIII).
    """

    arm_step: PositiveFloat = 0.03
    """Largest change of an arm joint's target per control step [rad]: 1.8 rad/s at 60 Hz. Not in the paper."""
    arm_lead: PositiveFloat = 0.15
    """Largest distance from an arm joint to its target [rad], so that a blocked arm does not wind up. Not in the
    paper."""
    hand: Literal["absolute", "relative"] = "absolute"
    """``absolute``: the action is the target between the joint's limits (the paper). ``relative``: the action moves the
    target, as for the arm, so that a policy that does nothing keeps a grasp. With absolute targets a new policy opens
    the hand in every demonstrated grasp, and learns to hold before it can learn to lift. In-hand manipulation is
    commonly learned with relative targets (Qi et al. 2022, In-Hand Object Rotation via Rapid Motor Adaptation)."""
    hand_step: PositiveFloat = 0.05
    """Largest change of a hand joint's target per control step [rad]: 3 rad/s at 60 Hz. Joints that slide move 4 cm
    for every radian."""
    jaw_step: PositiveFloat | None = None
    """Largest change of the force of a jaw's fingertips per control step [N], if ``hand_step`` would give more; None:
    no limit. One drive moves a jaw, which may be so stiff that exploration opens it at once. Hands with more joints
    ignore this."""
    hand_lead: PositiveFloat = 0.4
    """Largest distance from a hand joint to its target [rad]. It limits how hard the joint presses: drives of the
    Sharpa hand reach their effort limits at 0.3 to 0.7."""


def _terms(**terms: dict[str, Any]) -> Any:
    """Return a field whose default is these terms."""
    return field(default_factory=lambda: Terms(deepcopy(terms)))


@frozen
class ObservationConfig(Checked):
    """What policy and critic observe: groups of named terms, in order (``xreset/task/observations.py``).

    The policy gets ``policy``, ``proprio`` and ``perception``; with cameras ``goal``, ``proprio`` and images. The
    critic gets ``policy``, ``proprio``, ``perception`` and ``privileged``. The paper says which observations are noisy
    (appendix C), not by how much.
    """

    EARLIER = ObservationOptions

    cloud_points: Annotated[
        PositiveInt, Rule("at most 100,000 points", lambda points: points <= 100_000)
    ] = 64
    """Points on the surface of the object (P)."""
    policy: Named = _terms(
        object_pos={"noise": 0.003},  # m
        object_quat={"noise": 0.02},  # rad
        goal_pos={},
        goal_quat={},
        gravity_fraction={},
        previous_action={},
    )
    """Object and goal."""
    proprio: Named = _terms(
        joint_pos={"noise": 0.005},  # rad
        joint_vel={"noise": 0.05, "scale": 0.1},  # rad/s, s/rad
        palm_pos={},
        palm_quat={},
        palm_linvel={},
        palm_angvel={},
        tip_pos={},
        tip_force={"scale": 0.1},  # 1/N
    )
    """The robot."""
    perception: OneTerm = _terms(
        cloud={"frames": 5, "noise": 0.002, "scale": 1.0},  # steps, m, 1/m
    )
    """Surface points of the object."""
    privileged: Named = _terms(
        object_linvel={},
        object_angvel={},
        goal_offset={},
        goal_turn={},
        least_tip_distance={},
        gravity_fraction={},
        reward={},
    )
    """For the critic only."""
    goal: Named = _terms(goal_pos={}, goal_quat={}, previous_action={})
    """What a policy with cameras gets instead of ``policy``."""

    @property
    def cloud_scale(self) -> float:
        """Factor on the coordinates of points and of cameras' views [1/m]."""
        (cloud,) = self.perception.values()
        return cloud.get("scale", 1.0)

    def without_noise(self) -> ObservationConfig:
        """Return the same observations without noise."""
        quiet = {}
        for group in GROUPS:
            terms = getattr(self, group).items()
            quiet[group] = Terms(
                {name: term | {"noise": 0.0} if "noise" in term else term for name, term in terms}
            )
        return replace(self, **quiet)


GROUPS = ("policy", "proprio", "perception", "privileged", "goal")
"""Tables of observations."""


@frozen
class RewardConfig(Checked):
    """The reward: named terms with weights (``xreset/task/rewards.py``). Defaults are appendix D.d of the paper."""

    EARLIER = RewardOptions

    terms: Named = _terms(
        reach={"function": "best_reach", "weight": 1.0, "width": 0.1},  # m
        grasp={"weight": 1.0, "force": 0.1},  # N
        position={"weight": 4.0, "width": 0.2},  # m
        rotation={"weight": 4.0, "width": 1.5},  # rad
        success={"weight": 10.0, "rotation": 0.2617993877991494},  # 15 degrees
        action={"weight": -0.005, "limited": True},
        action_rate={"weight": -0.005, "limited": True},
        out_of_bounds={"weight": -500.0},
    )
    """The terms, in the order in which they are added. ``--config.task.reward.terms.reach.width 0.4`` changes one.
    Weight 0 switches a term off. The object is at its goal where the term ``success`` is not 0. A term
    ``module:function`` is the user's own (docs/own-reward.md)."""
    gate: OneTerm = _terms(touching={"force": 0.1})  # N
    """Condition of the terms position, rotation, points and success."""
    success_position: PositiveFloat = 0.02
    """Largest distance to the goal that is a success [m] (section V)."""
    scale: PositiveFloat = 0.01
    """Factor on the total (Table VIII)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, term in self.terms.items():
            if not isinstance(term.get("weight"), int | float):
                raise WrongValueError(
                    f"the reward term {shown(name)} has {shown(term)}, expected a weight as well: add"
                    f" --config.task.reward.terms.{shown(name)[1:-1]}.weight 1.0"
                )

    @property
    def own(self) -> Terms:
        """The terms of the user: ``module:function``."""
        return Terms({name: term for name, term in self.terms.items() if ":" in name})

    def without_own(self) -> RewardConfig:
        """Return the reward without the terms of the user."""
        kept = {name: term for name, term in self.terms.items() if ":" not in name}
        return replace(self, terms=Terms(kept))


@frozen
class TerminationConfig(Checked):
    """When an episode ends. xreset/task/terminations.py has the bounds of the scene."""

    episode_seconds: float = 5.0
    """Time limit [s], from one control step to 1,000,000 s. Its end is not a failure: the value is bootstrapped."""


@frozen
class ResetConfig(Checked):
    """The reset mixture (sections IV-B, appendix D.c, D.e, Table IX)."""

    demo_probability: Share = 0.5
    """p: share of resets from the bank; 0 is X-Sim."""
    pre_contact_only: bool = False
    """Use only bank states before first contact."""
    random_gravity: bool = True
    """Bank resets: gravity fraction U(0, 1); False: 1 (the paper's ablation, and better in docs/lab-book.md)."""
    home_gravity_std: NonNegativeFloat = 1.0
    """Home resets: standard deviation of the object's gravity [m/s^2] around 9.81; 0 is exactly full gravity."""
    spawn_xy: NonNegativeFloat = 0.02
    """Home resets: the object is moved by U(-x, x) in both directions [m]."""
    spawn_yaw: NonNegativeFloat = 0.4363323129985824
    """Home resets: the object is turned about the vertical by U(-y, y) [rad], 25 degrees."""
    training_xy: NonNegativeFloat | None = None
    """Replaces ``spawn_xy`` in trainings, so that starts vary more than in evaluations [m]; None: ``spawn_xy``."""
    goal_xy: NonNegativeFloat = 0.0
    """Home resets: the goal is moved by U(-x, x) in both directions [m]."""
    goal_z: NonNegativeFloat = 0.0
    """Home resets: the goal is moved by U(-z, z) upwards [m], but not below the height at which the object starts."""
    goal_yaw: NonNegativeFloat = 0.0
    """Home resets: the goal is turned about the vertical by U(-y, y) [rad]."""
    crossed_goals: Share = 0.0
    """Trainings: share of episodes whose goal is another demonstration's of the same object: the same place over the
    table, lift and turn, from the start of the episode's own demonstration."""
    object_share: Annotated[
        dict[str, float], Rule("names of objects and numbers above 0", _are_shares)
    ] = field(default_factory=dict)
    """Trainings: name of an object -> its number of worlds, relative to an object that is not named. More worlds give
    more practice with objects that are learned late."""
    adaptive_share: Share = 0.0
    """Trainings: share of episodes that draw one of their object's demonstrations in proportion to its recent failures
    from home. The other episodes draw evenly. BeyondMimic (Liao et al. 2025) samples the parts of a motion in this
    way."""


@frozen
class TrackerConfig(Checked):
    """Faults of the tracker that observes the object's pose. They move the observed pose and points together.

    All are off by default. The delay of a pose is ``observation_latency`` of the randomization.
    """

    interval: Range = (1.0, 1.0)
    """Range of the time from one pose to the next [control steps], drawn for every pose and rounded. Until then the
    last pose is observed. With control at 60 Hz, 2 is a tracker of 30 Hz."""
    jitter: NonNegativeFloat = 0.0
    """The delay of a pose differs from ``observation_latency`` by U(-j, j) [control steps], drawn at every step. It
    stays between 0 and the longest delay."""
    position_bias: NonNegativeFloat = 0.0
    """Error of the position during a whole episode: U(-b, b) along each axis [m]."""
    rotation_bias: NonNegativeFloat = 0.0
    """Error of the orientation during a whole episode: U(-b, b) about each axis [rad]."""
    position_noise: NonNegativeFloat = 0.0
    """Error of each pose's position: U(-n, n) along each axis [m]."""
    rotation_noise: NonNegativeFloat = 0.0
    """Error of each pose's orientation: U(-n, n) about each axis [rad]."""
    loss: Share = 0.0
    """Probability that the tracker loses the object after a pose."""
    loss_steps: Range = (1.0, 1.0)
    """Range of the time that it takes to find the object again [control steps], in addition to ``interval``."""

    @property
    def has_errors(self) -> bool:
        """Whether poses have a bias or noise."""
        bias = (self.position_bias, self.rotation_bias)
        noise = (self.position_noise, self.rotation_noise)
        return max(*bias, *noise) > 0

    @property
    def skips_steps(self) -> bool:
        """Whether some control steps have no new pose."""
        return self.interval[1] > 1 or self.loss > 0


@frozen
class PushConfig(Checked):
    """Pushes on object and arm, each during one control step. All are off by default."""

    probability: Annotated[
        tuple[float, float],
        Rule("two numbers above 0 and at most 1", lambda x: 0 < x[0] <= x[1] <= 1),
    ] = (0.001, 0.1)
    """Range of the probability of a push per control step. Each episode draws one, log-uniformly."""
    object_velocity: NonNegativeFloat = 0.0
    """Largest change of the object's velocity [m/s], in any direction, by a force at its centre of mass."""
    object_spin: NonNegativeFloat = 0.0
    """Largest change of the object's angular velocity [rad/s], about any axis, by a torque."""
    arm_torque: NonNegativeFloat = 0.0
    """Largest torque on each joint of the arm, as a share of the joint's effort limit. The joint's target is moved by
    torque / stiffness, which acts like the torque itself until the drive reaches its effort limit."""
    when: Literal["always", "gated"] = "always"
    """``gated``: the object is pushed only while the gate of the reward is open (``task.reward.gate``). Pushes on the
    arm are never gated."""

    @property
    def moves_object(self) -> bool:
        """Whether the object is pushed."""
        return self.object_velocity > 0 or self.object_spin > 0


@frozen
class RandomizationConfig(Checked):
    """Physical parameters, delays and faults drawn at each reset.

    ``friction`` to ``mass_scale`` are the paper's (Table IX). The others differ between one robot and the next and are
    off by default; docs/sim-to-sim.md has their effect on policies.
    """

    enabled: bool = True
    friction: Range = (0.5, 1.0)
    """Range of the object material's coefficient."""
    elastomer: NonNegativeFloat = 0.8
    """Coefficient of the fingertips' material. The friction of a pair is the mean of its two materials, as in the
    paper's simulator."""
    metal: NonNegativeFloat = 0.1
    """Coefficient of every other link's material."""
    table: NonNegativeFloat = 0.5
    """Coefficient of the table's material. Not in the paper."""
    mass_scale: PositiveRange = (0.7, 1.3)
    """Range of the factor on the object's mass."""
    torsional_friction: Range = (1.0, 1.0)
    """Range of the factor on the torsional friction of the object's pairs."""
    object_inertia: PositiveRange = (1.0, 1.0)
    """Range of the factor on the object's inertia, in addition to the factor on its mass."""
    object_com: Range = (0.0, 0.0)
    """Range of the distance [m] by which the object's centre of mass is moved, in any direction."""
    hand_friction: Range | None = None
    """Range of the coefficient of every link's material except the fingertips'; None: ``metal``."""
    arm_stiffness: Range = (1.0, 1.0)
    """Range of the factor on the stiffness of the arm's drives, the same for all of them."""
    arm_damping: Range = (1.0, 1.0)
    """Range of the factor on the damping of the arm's drives."""
    hand_stiffness: Range = (1.0, 1.0)
    """Range of the factor on the stiffness of the hand's drives."""
    hand_damping: Range = (1.0, 1.0)
    """Range of the factor on the damping of the hand's drives."""
    effort: Range = (1.0, 1.0)
    """Range of the factor on the effort limit of every drive."""
    action_latency: Range = (0.0, 0.0)
    """Range of the delay of actions [control steps]. Between whole steps the two targets are interpolated, which is
    their mean over the step; a physics step is 1 / ``substeps`` of a control step."""
    hand_latency: Range | None = None
    """Range of the delay of the hand's actions [control steps]; None: the hand has the delay of the arm."""
    lost_actions: Annotated[Range, Rule("shares of at most 1", lambda x: x[1] <= 1)] = (0.0, 0.0)
    """Range of the share of actions that do not arrive: the targets stay where they are. Each episode draws one."""
    observation_latency: Range = (0.0, 0.0)
    """Range of the delay of the observed object pose and cloud [control steps]."""
    proprio_latency: Range = (0.0, 0.0)
    """Range of the delay of the group ``proprio`` [control steps], rounded to whole ones."""
    force_gain: Range = (1.0, 1.0)
    """Range of the factor on the fingertips' force readings."""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    push: PushConfig = field(default_factory=PushConfig)
    camera_shift: Range = (0.0, 0.0)
    """Range of the distance by which a camera is moved, in any direction [m]."""
    camera_turn: Range = (0.0, 0.0)
    """Range of the angle by which a camera is turned, about any axis [rad]."""
    camera_fov: Range = (1.0, 1.0)
    """Range of the factor on the field of view."""
    camera_noise: Range = (1.0, 1.0)
    """Range of the factor on the errors of depth images."""
    camera_latency: Range = (0.0, 0.0)
    """Range of the additional age of images [control steps], rounded to whole steps."""

    def pair_friction(self, material: Any, link: Any = None) -> tuple[Any, Any, Any]:
        """Return the friction of the pairs object-fingertip, object-link, object-table: numbers or tensors.

        Args:
            material: the object material's coefficient. A pair's coefficient is the mean of its two materials.
            link: coefficient of the links except the fingertips; None: ``metal``.
        """
        others = (self.elastomer, self.metal if link is None else link, self.table)
        tip, link, table = ((material + other) / 2 for other in others)
        return tip, link, table

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tracker.jitter and not self.observation_latency[1]:
            raise WrongValueError(
                "tracker.jitter changes observation_latency, which is 0. Set observation_latency"
            )

    def draws(self, *names: str) -> bool:
        """Whether one of these ranges differs from its default."""
        return self.enabled and any(
            getattr(self, name) != getattr(_AS_STATED, name) for name in names
        )

    def longest(self, name: str) -> float:
        """Return the largest delay of a range [control steps]; 0: there is none."""
        limits = getattr(self, name)
        return limits[1] if self.enabled and limits else 0.0

    @property
    def scales_drives(self) -> bool:
        """Whether drives differ from what the robot spec says."""
        return self.draws(
            "arm_stiffness", "arm_damping", "hand_stiffness", "hand_damping", "effort"
        )


_AS_STATED = RandomizationConfig()


@frozen
class TaskConfig(Checked):
    """Everything that defines the task apart from robot, objects and reset bank."""

    action: ActionConfig = field(default_factory=ActionConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    termination: TerminationConfig = field(default_factory=TerminationConfig)
    reset: ResetConfig = field(default_factory=ResetConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    vision: VisionConfig = field(default_factory=VisionConfig)
    timestep: PositiveFloat = 1.0 / 240.0
    """Physics timestep [s]."""
    substeps: PositiveInt = 4
    """Physics steps per control step: control at 60 Hz. Not in the paper."""
    object_frame: Literal["mesh", "center"] = "mesh"
    """Origin of the object in observations, rewards, ends of episodes, perturbed starts and goals, and the draft's
    metrics. ``mesh``: the origin of the mesh file (the paper). ``center``: the center of volume of the convex hull,
    which does not depend on the file's origin and axes. With the observations of the recipe ``any_object`` the
    file's axes have no effect either."""
    distance_points: PositiveInt = 256
    """Surface points per object for fingertip distances."""
    joint_slots: (
        Annotated[tuple[int, int], Rule("two whole numbers above 0", lambda x: min(x) > 0)] | None
    ) = None
    """Slots of a policy for several robots: for joints of the arm, and of each of the five fingers
    (``xreset/task/slots.py``). None: the policy has the joints of its robot, in their order."""

    @property
    def control_dt(self) -> float:
        """Time between two actions [s]."""
        return self.timestep * self.substeps

    def sizes(self, num_joints: int, num_tips: int) -> tuple[int, int]:
        """Return the numbers of joints and fingertips that a policy for a robot observes: its own, or slots."""
        if self.joint_slots is None:
            return num_joints, num_tips
        arm, finger = self.joint_slots
        return arm + len(FINGERS) * finger, len(FINGERS)

    @property
    def policy_groups(self) -> tuple[str, str, str]:
        """Names of the observation groups that a policy gets: two flat ones, then clouds or images."""
        if self.vision.cameras:
            return "goal", "proprio", "view"
        return "policy", "proprio", "perception"

    def __post_init__(self) -> None:
        super().__post_init__()
        seconds = self.termination.episode_seconds
        if not (1 - 1e-6) * self.control_dt <= seconds <= LONGEST_EPISODE:
            raise WrongValueError(
                f"episode_seconds is {shown(seconds)}, expected a number from {self.control_dt:.3g}, which is one "
                f"control step, to {LONGEST_EPISODE:,.0f}"
            )
        steps = seconds / self.control_dt
        delays = ("action_latency", "hand_latency", "observation_latency", "proprio_latency")
        for name in (*delays, "camera_latency"):
            longest = self.randomization.longest(name)
            if longest >= steps:
                raise WrongValueError(
                    f"{name} goes up to {longest:g} control steps, expected fewer than the {steps:.0f} of an episode"
                )


EVALUATION_TIMESTEP = 1.0 / 240.0
"""Physics timestep of evaluations [s], also of policies that were trained with another one."""


def evaluation_task(task: TaskConfig) -> TaskConfig:
    """Return the task in which a policy is evaluated: from home at full gravity, with nominal physics and no noise.

    Spawns stay perturbed by ``spawn_xy`` and ``spawn_yaw``; goals are the demonstrated ones. Physics takes steps of
    :data:`EVALUATION_TIMESTEP` if a whole number of them makes a control step. Reward terms of the user are removed: no
    metric depends on them, and an evaluation does not need their module.
    """
    substeps = round(task.control_dt / EVALUATION_TIMESTEP)
    if substeps and abs(substeps * EVALUATION_TIMESTEP - task.control_dt) < 1e-9:
        task = replace(task, timestep=EVALUATION_TIMESTEP, substeps=substeps)
    return replace(
        task,
        observation=task.observation.without_noise(),
        reward=task.reward.without_own(),
        reset=ResetConfig(
            demo_probability=0.0,
            home_gravity_std=0.0,
            spawn_xy=task.reset.spawn_xy,
            spawn_yaw=task.reset.spawn_yaw,
        ),
        randomization=replace(task.randomization, enabled=False),
    )


def with_episodes_of(task: TaskConfig, seconds: float) -> TaskConfig:
    """Return the task with episodes of another length [s].

    Raises:
        XResetError: the length is not a number, too large, or less than a control step.
    """
    try:
        return replace(task, termination=replace(task.termination, episode_seconds=seconds))
    except ValueError as error:
        raise XResetError(
            f"{error}. Give another length, or none to use the length of the policy's training."
        ) from None
