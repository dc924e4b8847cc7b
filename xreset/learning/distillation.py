"""Distillation: a student that sees learns the actions of a teacher that is told (DAgger, Ross et al. 2011).

The student acts, the teacher says what it would do in the same states, and the student learns that. rsl-rl's own update
takes one step of all worlds at a time and forgets the memory of a recurrent teacher; here minibatches are sequences of
some worlds, as in :mod:`xreset.learning.ppo`.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import Distillation
from tensordict import TensorDict
from torch import Tensor

from xreset.learning.ppo import sequences


class SequenceDistillation(Distillation):
    """rsl-rl's distillation with an update on sequences.

    Attributes:
        teacher_share: share of the worlds in which the teacher acts.
    """

    def __init__(self, *args: Any, sequence_length: int, num_mini_batches: int, **options: Any) -> None:
        """Set up as rsl-rl does."""
        super().__init__(*args, gradient_length=1, **options)
        self.sequence_length = sequence_length
        self.num_mini_batches = num_mini_batches
        self.teacher_share = 0.0

    def act(self, obs: TensorDict) -> Tensor:
        """[N, J] the actions to take: the student's, and the teacher's in the first of the worlds."""
        transition = self.transition
        transition.hidden_states = (self.student.get_hidden_state(), None)
        acted = self.student(obs, stochastic_output=True).detach()
        taught = self.teacher(obs).clamp(-1.0, 1.0).detach()
        transition.observations = obs
        transition.privileged_actions = taught
        led = int(self.teacher_share * len(taught))
        transition.actions = torch.cat((taught[:led], acted[led:]))
        return transition.actions

    def update(self) -> dict[str, float]:
        """Learn from the rollout; return the mean squared error of the student's actions."""
        storage = self.storage
        memory = self.student.get_hidden_state()
        total = torch.zeros((), device=self.device)
        for _ in range(self.num_learning_epochs):
            order = torch.randperm(storage.num_envs, device=self.device)
            for worlds in order.tensor_split(self.num_mini_batches):
                first, states = sequences(storage, worlds, self.sequence_length)
                actions = self.student(storage.observations[:, worlds], masks=first, hidden_state=states)
                loss = self.loss_fn(actions, storage.privileged_actions[:, worlds])
                self.optimizer.zero_grad()
                loss.backward()
                if self.is_multi_gpu:
                    self.reduce_parameters()
                torch.nn.utils.clip_grad_norm_(self.student.parameters(), self.max_grad_norm or torch.inf)
                self.optimizer.step()
                total += loss.detach()
        self.student.update_normalization(storage.observations.flatten(0, 1))
        self.student.reset(hidden_state=memory)
        storage.clear()
        return {"behavior": float(total) / (self.num_learning_epochs * self.num_mini_batches)}

    def save(self) -> dict[str, Any]:
        """Return what a checkpoint holds. The teacher is in a file of its own."""
        return {
            "actor_state_dict": self.student.state_dict(),
            "critic_state_dict": {},
            "optimizer_state_dict": self.optimizer.state_dict(),
        }

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Continue with a checkpoint's student."""
        self.student.load_state_dict(loaded_dict["actor_state_dict"], strict=strict)
        self.optimizer.load_state_dict(loaded_dict["optimizer_state_dict"])
        return True
