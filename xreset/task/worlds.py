"""The state of the worlds of a task that lasts from step to step, in addition to the engine's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from xreset.physics.tensors import Tensors, where

Sample = Callable[[torch.Generator], Tensor]
"""Draws new values of a buffer, as many as it has."""
_Bundle = TypeVar("_Bundle", bound=Tensors)


class Worlds:
    """Buffers of N worlds. Those with a sample are drawn again when an episode begins, in the order of their creation.

    Attributes:
        buffers: all buffers [N, ...] by name.
    """

    def __init__(self, num_worlds: int, device: torch.device) -> None:
        """Start without buffers."""
        self.num_worlds = num_worlds
        self.device = device
        self.buffers: dict[str, Tensor] = {}
        self._samples: list[tuple[Sample, Tensor]] = []

    def zeros(self, *shape: int) -> Tensor:
        """[N, ...] zeros that do not last."""
        return torch.zeros(self.num_worlds, *shape, device=self.device)

    def keep(self, name: str, buffer: Tensor, sample: Sample | None = None) -> Tensor:
        """Add a buffer [N, ...], and return it.

        Args:
            name: the buffer's name, which no other has.
            buffer: [N, ...] its first values.
            sample: draws its values; None: it is not drawn.
        """
        assert name not in self.buffers, f"two buffers are called {name}"
        self.buffers[name] = buffer
        if sample is not None:
            self._samples.append((sample, buffer))
        return buffer

    def keep_bundle(self, name: str, bundle: _Bundle) -> _Bundle:
        """Add the tensors of a bundle [N, ...] as ``name.field``, and return the bundle."""
        for field in fields(bundle):
            self.keep(f"{name}.{field.name}", getattr(bundle, field.name))
        return bundle

    def draw(self, fresh: Tensor, generator: torch.Generator) -> None:
        """Draw new values for the worlds of a mask [N]. All worlds draw, so that no GPU waits for a count."""
        for sample, buffer in self._samples:
            values = sample(generator).view_as(buffer)
            buffer.copy_(where(fresh, values, buffer))

    def redirect(self, seeds: Sequence[Sequence[int]]) -> None:
        """Turn what is drawn in any direction so that the seed of each world alone decides where it points."""
        for number, name in enumerate(("object_com", "camera_shift", "camera_turn")):
            if name not in self.buffers:
                continue
            offset = self.buffers[name]
            rows = []
            for seed in seeds:
                random = np.random.default_rng([*seed, number])
                rows.append(random.normal(size=offset.shape[1:]))
            direction = torch.nn.functional.normalize(torch.as_tensor(np.array(rows)), dim=-1)
            # whole micrometres, because the former direction has rounded the length
            length = offset.double().norm(dim=-1, keepdim=True).round(decimals=6)
            offset.copy_(length * direction.to(length))

    def clone(self) -> dict[str, Tensor]:
        """Return a copy of all buffers by name."""
        return {name: buffer.clone() for name, buffer in self.buffers.items()}

    def copy(self, values: Mapping[str, Tensor], mask: Tensor) -> None:
        """Write values into the buffers of the same names, in the worlds of a mask [N]."""
        for name, value in values.items():
            self.buffers[name][mask] = value[mask]
