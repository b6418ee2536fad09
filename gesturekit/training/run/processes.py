"""Training in several processes, as torchrun starts them: who I am, my share, the mean gradient.

Every process builds the same networks from the same seeds and draws the same random numbers; of
each batch it takes its share, and gradients are averaged before each optimiser step, so that all
hold the same weights and the run is that of one process with the whole batch, up to the rounding
of sums. The first process alone writes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as distributed
from torch import Tensor, nn

from gesturekit.errors import ConfigError


@dataclass(frozen=True)
class Processes:
    """The processes of a run; alone, rank 0 of 1, where torchrun did not start it.

    Attributes:
        rank: my number, 0 for the first.
        count: how many there are.
        local_rank: my number on this machine, which is the number of my GPU.
    """

    rank: int = 0
    count: int = 1
    local_rank: int = 0

    @classmethod
    @contextmanager
    def from_environment(cls, device: str = "auto") -> Iterator[Processes]:
        """Join the processes that torchrun started, and leave them at the end.

        Args:
            device: what each trains on; `cpu` (or no GPU) is joined by gloo, a GPU by NCCL.

        Raises:
            ConfigError: torchrun's variables are incomplete or no numbers.
        """
        if "WORLD_SIZE" not in os.environ:
            yield cls()
            return
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
        try:
            rank, count, local = (int(os.environ[name]) for name in names)
        except (KeyError, ValueError) as error:
            raise ConfigError(
                f"environment: {', '.join(names)} must all be numbers ({error}); torchrun sets them"
            ) from None
        processes = cls(rank, count, local)
        if count == 1:
            yield processes
            return
        on_gpu = device != "cpu" and torch.cuda.is_available()
        if on_gpu:
            torch.cuda.set_device(local)
        distributed.init_process_group("nccl" if on_gpu else "gloo")
        try:
            yield processes
        finally:
            distributed.destroy_process_group()

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes and speaks."""
        return self.rank == 0

    def share(self, n: int) -> slice:
        """My part of n things, as equal as can be; empty where there are fewer than processes."""
        return slice(n * self.rank // self.count, n * (self.rank + 1) // self.count)

    def device(self, name: str) -> str:
        """`cuda` with my own GPU's number; other names as they are."""
        alone = self.count == 1 or not torch.cuda.is_available()
        return name if alone or name not in ("auto", "cuda") else f"cuda:{self.local_rank}"

    def average_gradients(
        self, parameters: Iterable[nn.Parameter], weight: float | None = None
    ) -> None:
        """Replace each gradient by its mean over all processes, in one exchange.

        Args:
            parameters: the same, in the same order, in every process. One without a gradient
                counts as zero.
            weight: my share of the batch where shares differ; they sum to 1 over the processes.
        """
        if self.count == 1:
            return
        parameters = list(parameters)
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        flat = torch.cat([parameter.grad.reshape(-1) for parameter in parameters])
        flat *= 1 / self.count if weight is None else weight
        distributed.all_reduce(flat)
        for parameter, part in zip(
            parameters, flat.split([p.numel() for p in parameters]), strict=True
        ):
            parameter.grad.copy_(part.view_as(parameter))

    def mean(self, value: Tensor) -> Tensor:
        """The mean of a tensor over all processes, for reports."""
        if self.count == 1:
            return value
        # NCCL reduces tensors on a GPU only.
        on_gpu = distributed.get_backend() == "nccl"
        total = value.to("cuda" if on_gpu else value.device, copy=True)
        distributed.all_reduce(total)
        return total.to(value.device) / self.count

    def wait(self) -> None:
        """Until all have come here, such as for what the first one writes."""
        if self.count > 1:
            distributed.barrier()
