"""Recording the outputs of a model's parts during a forward pass."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

Hook = Callable[[nn.Module, tuple[Any, ...], Any], None]


class Recorder:
    """Observes during ``with recorder: model(...)``; of several passes the first is kept. The forward pass is not changed.

    Subclasses register what they want to see in `observe`.
    """

    def __init__(self) -> None:
        self.records: dict[str, Tensor] = {}
        self.handles: list[RemovableHandle] = []

    def observe(self) -> None:
        """Attach to the model."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.observe()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for handle in self.handles:
            handle.remove()
        self.handles.clear()

    def record(self, name: str, value: Tensor) -> None:
        """Keep a copy, unless there is one."""
        self.records.setdefault(name, value.detach().clone())

    def hook(self, module: nn.Module, hook: Hook) -> None:
        """Call ``hook(module, inputs, output)`` after every call of the module."""
        self.handles.append(module.register_forward_hook(hook))

    def output(self, module: nn.Module, name: str) -> None:
        """Record what the module returns."""
        self.hook(module, lambda _module, _inputs, output: self.record(name, output))

    def input(self, module: nn.Module, name: str) -> None:
        """Record the module's first argument."""
        self.hook(module, lambda _module, inputs, _output: self.record(name, inputs[0]))
