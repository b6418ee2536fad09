"""Session of a training: its processes, device and run folder.

Training is data-parallel in several processes that torchrun starts.

Every process builds the same networks from the same seeds and draws the same random numbers. It
computes its share of each batch. Gradients are averaged before each optimiser step, so that the
result equals that of one process up to the rounding of sums. Only the first process writes.

Each process has a GPU of its own, or processes share GPUs if a machine has fewer: useful to try a
configuration, but slower than one process. NCCL refuses two processes on one GPU, so gloo then
averages the gradients, through the CPU.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as distributed
from torch import Tensor, nn
from tqdm.contrib.logging import logging_redirect_tqdm

from gesturekit.errors import ConfigError, ModelError, OutputError, is_full
from gesturekit.progress import Progress
from gesturekit.training.config import to_dict
from gesturekit.training.run_config import RunConfig
from gesturekit.training.run_folder import Run, resume_command

log = logging.getLogger(__name__)

_LONGEST_WAIT = timedelta(days=1)
"""Others wait while the first process reads the corpus, which may take hours; torch would give up
after ten minutes. If the first process dies, torchrun ends the others at once."""


@dataclass(frozen=True)
class Processes:
    """Processes of a run; rank 0 of 1 without torchrun.

    Attributes:
        rank: index of this process.
        count: number of processes.
        local_rank: index of this process on its machine, and of its GPU.
    """

    rank: int = 0
    count: int = 1
    local_rank: int = 0

    @classmethod
    @contextmanager
    def from_environment(cls, device: str = "auto") -> Iterator[Processes]:
        """Join the processes that torchrun started; leave them at the end.

        Args:
            device: training device. The backend is NCCL if each process has a GPU of its own, else
                gloo.

        Raises:
            ConfigError: torchrun's variables are incomplete or not numbers.
        """
        names, rank, count, local, here = ("RANK", "WORLD_SIZE", "LOCAL_RANK"), 0, 1, 0, 1
        if "WORLD_SIZE" in os.environ:
            try:
                rank, count, local = (int(os.environ[name]) for name in names)
                here = int(os.environ.get("LOCAL_WORLD_SIZE", count))
            except (KeyError, ValueError) as error:
                raise ConfigError(
                    f"environment: {', '.join(names)} and LOCAL_WORLD_SIZE, if it is set, must be "
                    f"numbers ({error}); torchrun sets them"
                ) from None
        processes, backend = cls(rank, count, local), "gloo"
        if count == 1:
            yield processes
            return
        if device in ("auto", "cuda") and torch.cuda.is_available():
            torch.cuda.set_device(processes.device(device))
            gpus = torch.cuda.device_count()
            backend = "nccl" if here <= gpus else "gloo"
            if here > gpus and processes.is_first:
                shared = "%d processes share %d GPU(s), which is slower than one each"
                log.warning(shared, here, gpus)
        distributed.init_process_group(backend, timeout=_LONGEST_WAIT)
        try:
            yield processes
        finally:
            distributed.destroy_process_group()

    @property
    def is_first(self) -> bool:
        """Return True for the process that writes and logs."""
        return self.rank == 0

    def share(self, n: int) -> slice:
        """Return this process's share of n items; shares differ by one item at most."""
        return slice(n * self.rank // self.count, n * (self.rank + 1) // self.count)

    def device(self, name: str) -> str:
        """Return the device name, with the index of this process's GPU where it applies."""
        if self.count == 1 or name not in ("auto", "cuda") or not torch.cuda.is_available():
            return name
        return f"cuda:{self.local_rank % torch.cuda.device_count()}"

    def average_gradients(self, parameters: Iterable[nn.Parameter], weight: float) -> None:
        """Replace each gradient by its mean over all processes, in one exchange.

        Args:
            parameters: in the same order in every process. A missing gradient counts as zero.
            weight: this process's share of the batch; weights sum to 1.
        """
        if self.count == 1:
            return
        parameters = list(parameters)
        for parameter in parameters:
            if parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        flat *= weight
        distributed.all_reduce(flat)
        parts = flat.split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean of a tensor over all processes."""
        if self.count == 1:
            return value
        # NCCL reduces tensors on a GPU only.
        on_gpu = distributed.get_backend() == "nccl"
        total = value.to("cuda" if on_gpu else value.device, copy=True)
        distributed.all_reduce(total)
        return total.to(value.device) / self.count

    def wait(self) -> None:
        """Wait until all processes have called this."""
        if self.count > 1:
            distributed.barrier()


def prepare_device(name: str, threads: int | None = None) -> torch.device:
    """Return the device of that name, set to deterministic algorithms and full float32.

    Args:
        name: auto (a GPU if there is one), cpu, cuda, cuda:1 ...
        threads: CPU threads; None leaves the choice to torch.

    Raises:
        ConfigError: no such device here.
    """
    if threads:
        torch.set_num_threads(threads)
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0]
        raise ConfigError(f"device: {name!r} cannot be used here ({reason})") from None
    if device.type == "cuda":
        # Same seed, same weights, on a GPU too; cuBLAS reads the variable at its first use.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        # It would fill every new tensor, for programs that read memory before they write it.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # made at run time
        # By default a GPU rounds the inputs of float32 convolutions to TF32, 10 bits, but not those
        # of matrix products. bfloat16 is the setting for speed.
        torch.backends.cudnn.allow_tf32 = False
    return device


def memory_ran_out(error: torch.cuda.OutOfMemoryError) -> str:
    """Return the part of torch's message that says how much memory was missing."""
    asked = ". ".join(str(error).split(". ")[:2])  # advice on the allocator follows
    return f"the GPU's memory ran out ({asked})"


def warn_of_slow_bfloat16(device: torch.device) -> None:
    """Warn if the processor has no bfloat16 arithmetic, and single precision is faster."""
    # Newer torch alone has the function.
    known: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    has_bfloat16 = known.get("avx512_bf16") or known.get("amx_bf16")
    if device.type == "cpu" and known.get("avx2") and not has_bfloat16:
        log.warning(
            "bf16: this processor has no bfloat16 arithmetic; fp32 is faster here (2.6 times with "
            "AVX2)"
        )


@contextmanager
def session(
    config: RunConfig, *, resume: bool, folder: Path | None = None
) -> Iterator[tuple[Run, torch.device, Processes]]:
    """Join torchrun's processes, if any, and open the run folder.

    On Ctrl-C and on a full disk the error names the command that resumes the run.

    Args:
        config: of the run.
        resume: continue the run in the folder.
        folder: replaces `config.out` for a temporary run.

    Raises:
        ConfigError: `config.out` holds a run already (or none to resume), is being trained by
            another process, or no such device.
        ModelError: a GPU's memory ran out.
        OutputError: the disk of the run folder is full.
    """
    with (
        Processes.from_environment(config.device) as processes,
        logging_redirect_tqdm(tqdm_class=Progress),
        _quiet_threads(),
    ):
        device = prepare_device(processes.device(config.device), config.threads)
        run = Run(folder or config.out, to_dict(config), resume=resume)
        # All processes check the folder before the first one writes into it.
        processes.wait()
        try:
            with closing(run):
                if processes.is_first and folder is None:
                    run.hold()
                yield run, device, processes
        except KeyboardInterrupt:
            if processes.is_first and folder is None and run.has_begun:
                hint = f"Continue with: {resume_command(run.folder, processes.count)}"
                raise KeyboardInterrupt(hint) from None
            raise
        except torch.cuda.OutOfMemoryError as error:
            raise ModelError(
                f"device {device}: {memory_ran_out(error)}; set a smaller training.batch or "
                "training.window, or device=cpu"
            ) from error
        except OSError as error:
            if not is_full(error):
                raise
            again = "start again"
            if run.has_begun:
                command = resume_command(run.folder, processes.count)
                again = f"continue from the last checkpoint: {command}"
            raise OutputError(f"{run.folder}: {error.strerror}; make room, then {again}") from error


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Print no traceback of a thread that found the disk full.

    TensorBoard's thread of writing raises its error in the main thread too.
    """
    usual = threading.excepthook
    threading.excepthook = lambda failed: None if is_full(failed.exc_value) else usual(failed)
    try:
        yield
    finally:
        threading.excepthook = usual
