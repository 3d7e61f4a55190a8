# SPDX-License-Identifier: Apache-2.0
"""
Calls that change an object, reported one by one as they are made, so that they can be repeated.

If the state of an object depends on such calls only, and every time and decision is
among their arguments, the same calls on a second object make it do the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol, TypeVar


class Call(NamedTuple):
    """
    One call of a method.

    Attributes:
        name: Name of the method.
        args: Its arguments by position; whoever keeps them must copy those that may change.
        kwargs: Its arguments by name.
    """

    name: str
    args: tuple[Any, ...]
    kwargs: dict[str, Any]

    def repeat(self, on: object) -> Any:
        """Make the call again, on another object."""
        return getattr(on, self.name)(*self.args, **self.kwargs)


class ReportsCalls(Protocol):
    """An object that reports its calls."""

    @property
    def on_call(self) -> Callable[[Call], object] | None:
        """Receiver of each call before it is made; None if nobody listens."""


S = TypeVar("S", bound=ReportsCalls)
P = ParamSpec("P")
T = TypeVar("T")


def reported(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """Report each call of a method; the method must not call another such method of its object."""
    name = method.__name__

    @wraps(method)
    def call(self: S, /, *args: P.args, **kwargs: P.kwargs) -> T:
        if (on_call := self.on_call) is not None:
            on_call(Call(name, args, kwargs))
        return method(self, *args, **kwargs)

    return call
