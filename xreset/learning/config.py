"""Configuration of learning. Defaults of networks and PPO are the paper's Table VIII; docstrings say what it leaves
open. Those of a training are the recipe of the headline results."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Literal

from xreset.errors import WrongValueError
from xreset.files.checks import (
    Checked,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Rule,
    Share,
    frozen,
)
from xreset.task.config import TaskConfig
from xreset.task.default import TASK

Widths = Annotated[
    tuple[int, ...],
    Rule("one width or more, each above 0", lambda widths: min(widths, default=0) >= 1),
]


@frozen
class ModelConfig(Checked):
    """Actor and critic: PointNet per cloud frame, LSTM with layer norm on its output, MLP."""

    pointnet: Widths = (64, 128, 64)
    """Widths of the per-point MLP 3 -> 64 -> 128 -> 64; the maximum over points is the frame's embedding."""
    lstm: PositiveInt = 512
    """Units of the LSTM."""
    mlp: Widths = (512, 256, 128)
    critic_mlp: Widths | None = None
    """Widths of the critic's MLP; None: those of the actor."""
    initial_std: PositiveFloat = 1.0
    """Initial standard deviation of the Gaussian policy, which does not depend on the state. Not in the paper."""
    normalize_returns: bool = False
    """Whether the critic learns returns in units of their running standard deviation, as the
    paper's library can."""

    @property
    def layers(self) -> dict[str, Any]:
        """The settings in which two networks must agree for one to take over the weights of the other."""
        layers = asdict(self)
        del layers["initial_std"]
        return layers


@frozen
class PpoConfig(Checked):
    """Proximal policy optimization."""

    horizon: Annotated[int, Rule("a whole number above 1", lambda steps: steps > 1)] = 16
    """Control steps per world and iteration. Not 1: rsl-rl stores LSTM states from a run's second step on."""
    sequence_length: PositiveInt = 4
    """Length of truncated back-propagation through time; divides the horizon."""
    mini_epochs: PositiveInt = 5
    minibatch_size: PositiveInt = 32768
    """Transitions per minibatch. With fewer transitions per iteration than two of these, an iteration is one
    minibatch."""
    discount: Share = 0.99
    learning_rate: PositiveFloat = 1e-3
    """Initial learning rate of actor and critic. It is divided (multiplied) by 1.5 where the policy moved more than
    twice (less than half) ``desired_kl``."""
    desired_kl: PositiveFloat = 0.01
    entropy: NonNegativeFloat = 0.005
    bounds_loss: NonNegativeFloat = 0.0
    """Weight of the squared excess of the actions' means over +-1.1, summed over actions: beyond the limit, noise
    explores nothing. The paper's library uses 1e-4."""
    value_loss: NonNegativeFloat = 1.0
    """Weight of the value loss. Not in the paper."""
    average: Share = 0.0
    """The policy that is exported has the mean of the weights over about this share of the iterations, the latest ones;
    0: it has the last weights. Iteration t has the weight 1 / (1 + average (t - 1)) in the running mean
    (polynomial-decay averaging, Shamir and Zhang 2013, Stochastic gradient descent for non-smooth optimization). The
    training itself goes on with the last weights. Not in the paper."""
    precision: Literal["float32", "tf32", "bfloat16"] = "tf32"
    """Arithmetic of matrix products on a GPU. ``bfloat16``: factors of point-cloud encoder and LSTM in bfloat16 (sums
    in float32), the rest in TF32. The CPU and the exported policy use float32. Not in the paper."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.horizon % self.sequence_length:
            raise WrongValueError(
                f"sequence_length is {self.sequence_length}, expected a divisor of the horizon, which is {self.horizon}"
            )

    def minibatches(self, num_worlds: int) -> int:
        """Return the number of minibatches of an iteration with this number of worlds in each process."""
        return max(1, min(num_worlds * self.horizon // self.minibatch_size, num_worlds // 2))


# The recipe of the headline results (docs/results.md) --------------------------------------------------------------

MODEL = ModelConfig(lstm=256, initial_std=0.3)
"""Networks of a training where nothing else is said."""

# Without the paper's entropy bonus the standard deviation only shrinks. With that and a doubled `desired_kl` a policy
# learns in a fraction of the iterations. With 4,096 worlds an iteration has twelve steps of the optimizer. Averaged
# weights: 0.8 points more task progress after 25 minutes (two seeds, docs/lab-book.md).
PPO = PpoConfig(
    average=0.08,
    mini_epochs=3,
    minibatch_size=16384,
    precision="bfloat16",
    desired_kl=0.02,
    entropy=0.0,
)
"""Learning of a training where nothing else is said."""


@frozen
class TrainConfig(Checked):
    """Configuration of a training run, as saved in the run folder.

    The defaults are the recipe ``default``, that of the headline results. Those of its parts, such as ``TaskConfig()``,
    are the recipe ``paper``.
    """

    task: TaskConfig = TASK
    model: ModelConfig = MODEL
    ppo: PpoConfig = PPO
    iterations: PositiveInt = 2600
    """Number of iterations of a training that is given neither iterations nor minutes; 2,600 with 4,096 worlds are 170
    M steps, or 25 minutes of one H100."""
    save_interval: PositiveInt = 50
    """Iterations between checkpoints."""
