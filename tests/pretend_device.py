"""A device that is not the CPU, for machines without one: its tensors compute on the CPU, but meet none of those there.

Code that leaves a tensor behind on the CPU, or reads one of the device as a numpy array, fails here as on a GPU. The
device is called "meta", which torch lets tensors be made on anywhere.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

PRETENDED = torch.device("meta")
MOVES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)


class PretendedTensor(torch.Tensor):
    """A tensor that says that it is on another device; `held` has its values."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> "PretendedTensor":
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.shape, strides=held.stride(), dtype=held.dtype, device=PRETENDED
        )
        made.held = held
        return made

    def __init__(self, held: torch.Tensor) -> None: ...

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


class _Pretend(TorchDispatchMode):
    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


class _MadeFromValues(TorchFunctionMode):
    """Tensors from Python's and numpy's values, which torch makes without asking a dispatch mode."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if function not in (torch.tensor, torch.as_tensor) or kwargs.get("device") is None:
            return function(*args, **kwargs)
        device = kwargs.pop("device")
        return function(*args, **kwargs).to(device)


def _run(function: Callable[..., Any], args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)]
    there = [each for each in tensors if isinstance(each, PretendedTensor)]
    left_behind = [each for each in tensors if not isinstance(each, PretendedTensor) and each.ndim]
    if there and left_behind and function not in MOVES:
        raise RuntimeError(f"{function}: tensors on the device and on the CPU, {[each.shape for each in left_behind]}")
    device = kwargs.get("device")
    goes_there = bool(there) if device is None else torch.device(device) == PRETENDED
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    values = function(
        *tree_map_only(PretendedTensor, lambda each: each.held, args),
        **tree_map_only(PretendedTensor, lambda each: each.held, kwargs),
    )
    if not goes_there:
        return values
    by_values = {id(each.held): each for each in there}

    def wrapped(value: torch.Tensor) -> torch.Tensor:
        known = by_values.get(id(value))
        return PretendedTensor(value) if known is None else known

    return tree_map_only(torch.Tensor, wrapped, values)


@contextmanager
def pretended_device() -> Iterator[torch.device]:
    """The device, which is there while the context is open."""
    with _Pretend(), _MadeFromValues():
        yield PRETENDED
