"""Matrix products of numpy on one thread.

Those of bundle adjustment take two to three milliseconds. The library beneath numpy (OpenBLAS) deals them out to all cores and lets its
threads spin until they meet: on idle cores that wins a millisecond, and beside other work it costs a hundred.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import threadpoolctl

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

_find_libraries = functools.cache(threadpoolctl.ThreadpoolController)


def on_one_blas_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """While ``function`` runs, numpy's matrix products have one thread, in the whole process."""

    @functools.wraps(function)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _find_libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return wrapped
