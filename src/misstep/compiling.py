"""Compiled loops that are kept for the next process, wherever there is room for them.

Numba keeps what it compiles beside the source or in the user's cache, and raises where it can write
to neither, or where what was kept is damaged. Here it is then kept in a folder of this process and
its children, and what is damaged is compiled anew.
"""

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache as once
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache

_FOLDER = "NUMBA_CACHE_DIR"


def njit(signature: Any = None, *, cache: bool = False, **options: Any) -> Callable[[Any], Any]:
    """Return a decorator that compiles a function.

    Parameters
    ----------
    signature : numba signature, optional
        Compile for these types at once, and for no others; otherwise when it is first called.
    cache : bool
        Keep what is compiled.
    **options
        Of `numba.njit`.
    """

    def decorate(function: Any) -> Any:
        dispatcher = numba.njit(**options)(function)
        if not hasattr(dispatcher, "_cache"):  # NUMBA_DISABLE_JIT
            return dispatcher
        if cache and (kept := _cache_of(function)):
            dispatcher._cache = kept
        if signature is not None:
            dispatcher.compile(signature)
            dispatcher.disable_compile()
        return dispatcher

    return decorate


class _Cache(FunctionCache):
    """What is kept of a function; without it the function works as well, but later."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged pickle raises anything
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # a full disk
            super().save_overload(sig, data)


def _cache_of(function: Any) -> _Cache | None:
    """Return where a function is kept; None where nothing can be written at all."""
    beside = os.access(Path(__file__).parent, os.W_OK)
    if not (beside or _has_home() or os.environ.get(_FOLDER)):
        _keep_for_this_process()
    try:
        return _Cache(function)
    except RuntimeError:  # neither beside the source nor in the user's cache
        _keep_for_this_process()
    try:
        return _Cache(function)
    except RuntimeError:
        return None


def _has_home() -> bool:
    """Say whether there is a user's cache; without a home, numba would make a folder ``~``."""
    return os.path.isabs(os.path.expanduser(os.environ.get("XDG_CACHE_HOME") or "~"))


@once
def _keep_for_this_process() -> None:
    """Keep what is compiled in a folder that goes when this process does; children use it too."""
    with suppress(OSError):
        folder = tempfile.mkdtemp(prefix="misstep-")
        os.environ[_FOLDER] = numba.config.CACHE_DIR = folder
        atexit.register(_take_away, folder, os.getpid())


def _take_away(folder: str, owner: int) -> None:
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)
