"""A simulated GPU: code for `device="cuda"` runs on the CPU, and mixed devices fail as on a GPU.

Inside `SimulatedGPU`, a tensor is on `cuda:0` if its storage was made there: by `.to("cuda")`, by
`device="cuda"`, or by an operation on such tensors. Values are computed on the CPU, by the code
for a GPU. It raises what a real GPU raises for a tensor left on the other device and for `.numpy()`
on a GPU's tensor.

Not simulated: rounding, streams, memory, autocast, and several processes.
"""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode

GPU, CPU = torch.device("cuda:0"), torch.device("cpu")
_TO_NUMPY = (Tensor.numpy, Tensor.__array__)
_INDEXED = {
    Tensor.__getitem__: 1,
    Tensor.__setitem__: 1,
    Tensor.index_put: 1,
    Tensor.index_put_: 1,
    torch.index_put: 1,
}
"""Operations with an index, and its position; an index may be on the CPU."""
_MIXED = (
    Tensor.copy_,
    Tensor.data.__set__,
    Tensor.grad.__set__,
    torch._has_compatible_shallow_copy_type,
)
"""Operations that take tensors of two devices."""
_WHOLE = (torch.cat, torch.stack, torch.concatenate, torch.index_select, Tensor.index_select)
"""Operations that refuse even a number on the CPU beside a GPU's tensors."""


class SimulatedGPU(TorchFunctionMode):
    """Context in which `cuda` is a device."""

    def __init__(self) -> None:
        super().__init__()
        # A weak reference frees the memory, but no later storage has the same address.
        self._storages: dict[int, StorageWeakRef] = {}

    def holds(self, tensor: Tensor) -> bool:
        """Return whether a tensor is on this GPU."""
        return tensor.untyped_storage()._cdata in self._storages

    def _put(self, made: Any) -> Any:
        for tensor in _tensors(made):
            storage = tensor.untyped_storage()
            if storage._cdata not in self._storages:
                self._storages[storage._cdata] = StorageWeakRef(storage)
        return made

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func == Tensor.device.__get__:
            return GPU if self.holds(args[0]) else CPU
        if func == Tensor.is_cuda.__get__:
            return self.holds(args[0])
        if func in (Tensor.to, Tensor.cpu, Tensor.cuda):
            return self._moved(func, args, kwargs)
        given = list(_tensors([args, kwargs]))
        here = [self.holds(tensor) for tensor in given]
        if func in _TO_NUMPY and any(here):
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu()")
        self._check(func, args, kwargs, given, here)
        wanted = kwargs.get("device")
        if wanted is not None:
            kwargs["device"] = CPU
            generator = kwargs.get("generator")
            is_gpu = torch.device(wanted).type == "cuda"
            if is_gpu and generator is not None:
                raise RuntimeError(f"{func}: Expected a 'cuda' device type for generator")
        else:
            is_gpu = any(here)
        made = func(*args, **kwargs)
        if wanted is not None and any(made is tensor for tensor in given):
            made = made.clone()  # `as_tensor` of a tensor
        return self._put(made) if is_gpu else made

    def _moved(self, func: Callable[..., Any], args: tuple, kwargs: dict[str, Any]) -> Tensor:
        tensor, *others = args
        wanted = {Tensor.cpu: CPU, Tensor.cuda: GPU}.get(func, kwargs.pop("device", None))
        rest = []
        for other in others:
            if isinstance(other, Tensor):
                wanted, other = (GPU if self.holds(other) else CPU), other.dtype
            if isinstance(other, str | torch.device):
                wanted = other
            elif isinstance(other, torch.dtype):  # else non_blocking
                rest.append(other)
        was = self.holds(tensor)
        is_gpu = was if wanted is None else torch.device(wanted).type == "cuda"
        made = tensor.to(*rest, **kwargs) if rest or kwargs else tensor
        if is_gpu != was and made is tensor:
            made = tensor.clone()
        return self._put(made) if is_gpu else made

    def _check(
        self,
        func: Callable[..., Any],
        args: tuple,
        kwargs: dict[str, Any],
        given: list[Tensor],
        here: list[bool],
    ) -> None:
        if func in _MIXED or not any(here) or all(here):
            return
        if func in _INDEXED:
            place = _INDEXED[func]
            if not self.holds(args[0]):
                raise RuntimeError("indices should be either on cpu or on the same device")
            if not list(_tensors(args[place])):
                return  # a slice is copied into
            args = args[:place] + args[place + 1 :]
            given = list(_tensors([args, kwargs]))
            here = [self.holds(tensor) for tensor in given]
        # Operations on elements take a number from the CPU; transformers passes an empty tensor.
        is_strict = func in _WHOLE
        stray = [
            tensor
            for tensor, is_here in zip(given, here)
            if not is_here and (is_strict or (tensor.ndim and tensor.numel()))
        ]
        if stray:
            raise RuntimeError(
                "Expected all tensors to be on the same device, but found at least two devices, "
                f"cuda:0 and cpu: {getattr(func, '__name__', func)} of "
                f"{[(tuple(t.shape), 'cuda' if h else 'cpu') for t, h in zip(given, here)]}"
            )


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        for part in value.values():
            yield from _tensors(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _tensors(part)
