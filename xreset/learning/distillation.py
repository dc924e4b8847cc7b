"""Distillation: a student that sees the object learns the actions of a teacher that is told its pose and shape (DAgger,
Ross et al. 2011).

The student acts, the teacher says what it would do in the same states, and the student learns that. rsl-rl's own update
takes one step of all worlds at a time and forgets the memory of a recurrent teacher. Here minibatches are sequences of
some worlds, as in :mod:`xreset.learning.ppo`.
"""

from __future__ import annotations

from pathlib import Path

import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from xreset.learning.config import TrainConfig
from xreset.learning.distributed import Processes
from xreset.learning.from_onnx import network_of
from xreset.learning.model import make_actor
from xreset.learning.ppo import GRAD_NORM, first_steps, piece_states
from xreset.policy.onnx_policy import OnnxPolicy

LED = 0.2
"""Share of a training in which the teacher acts as well: in all worlds at the beginning, then in fewer and fewer."""


class SequenceDistillation(Distillation):
    """rsl-rl's distillation with an update on sequences.

    Attributes:
        networks: name -> network that a checkpoint holds. The teacher is in a file of its own.
        teacher_share: share of the worlds in which the teacher acts.
    """

    def __init__(
        self,
        obs: TensorDict,
        num_actions: int,
        config: TrainConfig,
        device: str,
        processes: Processes,
        teacher: Path,
    ) -> None:
        """Make student, teacher and storage; ``obs`` are the observations of all worlds of this process."""
        p = config.ppo
        student = make_actor(obs, num_actions, config)
        super().__init__(
            student,
            network_of(OnnxPolicy(teacher)),
            RolloutStorage("distillation", len(obs), p.horizon, obs, [num_actions], device),
            num_learning_epochs=p.mini_epochs,
            gradient_length=1,
            learning_rate=p.learning_rate,
            max_grad_norm=GRAD_NORM,
            device=device,
            multi_gpu_cfg=processes.ranks,
        )
        self.networks = {"actor": student}
        self.sequence_length = p.sequence_length
        self.num_mini_batches = p.minibatches(len(obs))
        self.teacher_share = 0.0

    def act(self, obs: TensorDict) -> Tensor:
        """[N, J] the actions to take: the student's, and the teacher's in the first of the worlds."""
        transition = self.transition
        transition.hidden_states = (self.student.get_hidden_state(), None)
        student_actions = self.student(obs, stochastic_output=True).detach()
        teacher_actions = self.teacher(obs).clamp(-1.0, 1.0).detach()
        num_led = int(self.teacher_share * len(teacher_actions))
        transition.observations = obs
        transition.privileged_actions = teacher_actions
        transition.actions = torch.cat((teacher_actions[:num_led], student_actions[num_led:]))
        return transition.actions

    def update(self) -> dict[str, float]:
        """Learn from the rollout; return the mean squared error of the student's actions."""
        storage = self.storage
        total = torch.zeros((), device=self.device)
        for _ in range(self.num_learning_epochs):
            order = torch.randperm(storage.num_envs, device=self.device)
            for worlds in order.tensor_split(self.num_mini_batches):
                states = piece_states(storage.saved_hidden_state_a, worlds, self.sequence_length)
                first = first_steps(storage, worlds)
                observations = storage.observations[:, worlds]
                actions = self.student(observations, masks=first, hidden_state=states)
                # nothing is learned about actions that a robot lacks
                mask = observations.get("action_mask", 1.0)
                taught = storage.privileged_actions[:, worlds]
                loss = self.loss_fn(mask * actions, mask * taught)
                self.optimizer.zero_grad()
                loss.backward()
                if self.is_multi_gpu:
                    self.reduce_parameters()
                torch.nn.utils.clip_grad_norm_(
                    self.student.parameters(), self.max_grad_norm or torch.inf
                )
                self.optimizer.step()
                total += loss.detach()
        self.student.update_normalization(storage.observations.flatten(0, 1))
        storage.clear()
        return {"behavior": float(total) / (self.num_learning_epochs * self.num_mini_batches)}
