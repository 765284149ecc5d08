"""Annotated shapes of tensors checked at run time: what jaxtyping's import hook calls for every function of the package.

Only array annotations are looked at (also as optional ones and inside returned tuples): mypy has seen to the rest.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

from jaxtyping import AbstractArray

_on = True


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Without the checks: for tests of what the package itself says about wrong shapes."""
    global _on
    _on = False
    try:
        yield
    finally:
        _on = True


class WrongShape(TypeError):
    """A value is not of the annotated shape or dtype."""


def check_shapes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Type checker for ``jaxtyped``: compares arguments and result with array annotations."""
    signature = inspect.signature(function)
    named = {name: item.annotation for name, item in signature.parameters.items()}
    hints = functools.cache(lambda: _array_hints(function, named | {"return": signature.return_annotation}))

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        known = hints()
        if not known or not _on:
            return function(*args, **kwargs)
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return function(*args, **kwargs)  # says itself what is missing
        for name, value in given.items():
            if name in known:
                _check(value, known[name], f"{function.__qualname__}: {name}")
        result = function(*args, **kwargs)
        if "return" in known:
            _check(result, known["return"], f"{function.__qualname__}: its result")
        return result

    return checked


def _array_hints(function: Callable[..., Any], annotations: dict[str, Any]) -> dict[str, Any]:
    found = {}
    for name, hint in annotations.items():
        if isinstance(hint, str):
            try:
                hint = eval(hint, getattr(function, "__globals__", {}))  # noqa: S307 - our own annotations
            except NameError:  # of a name for type checkers only
                continue
        if _has_array(hint):
            found[name] = hint
    return found


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def _has_array(hint: Any) -> bool:
    return _is_array(hint) or any(_has_array(part) for part in typing.get_args(hint))


def _check(value: Any, hint: Any, what: str) -> None:
    if _is_array(hint):
        if not isinstance(value, hint):
            shape = getattr(value, "shape", type(value).__name__)
            raise WrongShape(
                f"{what} is {getattr(value, 'dtype', '')} {tuple(shape) if shape else shape}, not {hint.__name__}"
            )
        return
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in parts:
            return
        arrays = [part for part in parts if _is_array(part)]
        if arrays and hasattr(value, "shape") and not any(isinstance(value, part) for part in arrays):
            raise WrongShape(
                f"{what} is {value.dtype} {tuple(value.shape)}, not one of {[part.__name__ for part in arrays]}"
            )
    elif origin is tuple and isinstance(value, tuple) and len(parts) == len(value) and Ellipsis not in parts:
        for index, (one, part) in enumerate(zip(value, parts, strict=True)):
            _check(one, part, f"{what}[{index}]")
