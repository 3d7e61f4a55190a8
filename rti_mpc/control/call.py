# SPDX-License-Identifier: Apache-2.0
"""
Calls that change an object, told one by one as they are made, so that they can be made again.

An object whose state follows from such calls alone, with every time and every
decision among their arguments, does the same when they are repeated on another one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol, TypeVar


class Call(NamedTuple):
    """
    One call of a method.

    Attributes:
        name: Of the method.
        args: Its arguments by position; whoever keeps them copies what may change.
        kwargs: Its arguments by name.
    """

    name: str
    args: tuple[Any, ...]
    kwargs: dict[str, Any]

    def repeat(self, on: object) -> Any:
        """Make the call again, on another object."""
        return getattr(on, self.name)(*self.args, **self.kwargs)


class Told(Protocol):
    """An object that tells of its calls."""

    @property
    def on_call(self) -> Callable[[Call], object] | None:
        """Takes each call before it is made, if anybody wants to know."""


S = TypeVar("S", bound=Told)
P = ParamSpec("P")
T = TypeVar("T")


def told(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """Let a method tell of its calls; it calls no other such method of its object."""
    name = method.__name__

    @wraps(method)
    def call(self: S, /, *args: P.args, **kwargs: P.kwargs) -> T:
        if (on_call := self.on_call) is not None:
            on_call(Call(name, args, kwargs))
        return method(self, *args, **kwargs)

    return call
