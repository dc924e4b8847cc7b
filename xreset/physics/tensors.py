"""Bundles of tensors: frozen dataclasses that are indexed, moved and joined together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar

if TYPE_CHECKING:  # functions import torch: bundles have names without it
    import torch
    from torch import Tensor

_Batch = TypeVar("_Batch", bound="Tensor | Tensors")


@dataclass(frozen=True)
class Tensors:
    """Base of a dataclass whose tensors share their first dimension.

    Other fields are kept. Only :meth:`to` also changes bundles inside a bundle.
    """

    def map(self, function: Callable[..., Tensor], *others: Self) -> Self:
        """Return a bundle of ``function(own tensor, *tensors of the others)``."""
        from torch import Tensor

        mapped = {}
        for f in fields(self):
            tensor = getattr(self, f.name)
            if isinstance(tensor, Tensor):
                mapped[f.name] = function(tensor, *(getattr(other, f.name) for other in others))
        return replace(self, **mapped)

    def __getitem__(self, rows: Any) -> Self:
        """Select rows."""
        return self.map(lambda x: x[rows])

    def __setitem__(self, rows: Any, values: Self) -> None:
        """Write rows in place."""
        self.map(lambda x, new: x.index_put_((rows,), new), values)

    def clone(self) -> Self:
        """Return a copy."""
        return self.map(lambda x: x.clone())

    def to(self, device: torch.device | str) -> Self:
        """Return the bundle on another device."""
        from torch import Tensor

        moved = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, Tensor | Tensors):
                moved[f.name] = value.to(device)
        return replace(self, **moved)

    @classmethod
    def cat(cls, parts: Sequence[Self], dim: int = 0) -> Self:
        """Concatenate bundles. Fields that are not tensors are those of the first."""
        import torch

        return parts[0].map(lambda *tensors: torch.cat(tensors, dim=dim), *parts[1:])


def where(mask: Tensor, yes: _Batch, no: _Batch) -> _Batch:
    """Select each row from ``yes`` or ``no`` by a mask [B]."""
    import torch

    if isinstance(yes, torch.Tensor):
        return torch.where(mask.view(-1, *[1] * (yes.dim() - 1)), yes, no)  # pyright: ignore
    return yes.map(lambda a, b: where(mask, a, b), no)  # pyright: ignore


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread. For small batches a second thread gains nothing, and slows other processes because it
    spins while it waits."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
