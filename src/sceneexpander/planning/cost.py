"""Peak memory and floating-point operations of whatever runs inside, on real or on fake tensors."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter
from torch.utils.flop_counter import flop_registry, sdpa_backward_flop_count, sdpa_flop_count


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Bytes alive at once at most, bytes still alive at the end, floating-point operations (a multiply-add is two)."""

    peak_bytes: int
    final_bytes: int
    flops: int


class Meter(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the bytes of every tensor storage made inside, from its making to its release, and the operations of products.

    Views share a storage and count once; scratch memory inside of a kernel is not seen. Operations are those of matrix products,
    convolutions and attention, by torch's own formulas.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.now = 0
        self.peak = 0
        self.flops = 0
        self._alive: set[int] = set()

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        formula = _FORMULAS.get(func._overloadpacket)
        if formula is None and torch.is_inference_mode_enabled() and func.namespace == "aten" and func._can_decompose():
            # Under inference_mode whole layers arrive here in one piece.
            with self:
                return func.decompose(*args, **kwargs)
        result = func(*args, **kwargs)
        if formula is not None:
            self.flops += formula(*args, **kwargs, out_val=result)
        for value in tree_iter(result):
            if isinstance(value, Tensor):
                self.count(value)
        return result

    def count(self, tensor: Tensor) -> None:
        """Take a tensor into account that was made outside."""
        storage = tensor.untyped_storage()
        identity = storage._cdata
        if identity in self._alive:
            return
        size = storage.nbytes()
        self._alive.add(identity)
        self.now += size
        self.peak = max(self.peak, self.now)
        weakref.finalize(storage, self._release, identity, size)

    def _release(self, identity: int, size: int) -> None:
        self._alive.discard(identity)
        self.now -= size


def _attention(query: Tensor, key: Tensor, value: Tensor, *_: Any, out_val: Any, **__: Any) -> int:
    return sdpa_flop_count(query.shape, key.shape, value.shape)  # type: ignore[no-untyped-call]


def _attention_backward(
    gradient: Tensor, query: Tensor, key: Tensor, value: Tensor, *_: Any, out_val: Any, **__: Any
) -> int:
    return sdpa_backward_flop_count(  # type: ignore[no-untyped-call]
        gradient.shape, query.shape, key.shape, value.shape
    )


# torch's table knows the attention kernels of GPUs only.
_FORMULAS: dict[Any, Any] = {
    **flop_registry,
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention,
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward: _attention_backward,
}
