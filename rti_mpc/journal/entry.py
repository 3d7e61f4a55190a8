# SPDX-License-Identifier: Apache-2.0
"""
Entries of a journal: the calls of a controller that its commands depend on, as bytes.

An entry is the place of its method in `METHODS` and its arguments. Of `in_time` the
command is left out, since it is the last proposal; of `receive_reference` the rows, since
they follow from the reference. Of a problem only weights and bounds are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from rti_mpc.control.call import Call
from rti_mpc.errors import JournalError
from rti_mpc.journal.value import ENCODING_VERSION, Decoder, at, check_version, encode_value
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS

# Names of the arguments of each method. Places in this table are on the wire: append only.
METHODS: dict[str, tuple[str, ...]] = {
    "receive_state": ("state", "arrival_ns"),
    "in_time": ("command", "local_ns"),
    "commit": ("command", "left_ns"),
    "prepare": (),
    "second_opinion": (),
    "tick": ("local_ns",),
    "receive_reference": ("reference", "rows"),
    "overhear": ("command",),
    "stand_by": (),
    "lead": ("epoch",),
    "stop": ("reason",),
    "enable": (),
    "retune": ("ocp", "version"),
    "standstill": ("local_ns",),
    "rewarm": (),
    "inject": ("failure", "samples"),  # of `rti_mpc_service.injection.FaultyRti`, where failures are enabled
}
NAMES = tuple(METHODS)
PLACES = {name: place for place, name in enumerate(NAMES)}


class JournalEntry(NamedTuple):
    """
    One entry.

    Attributes:
        seq: Its number.
        name: Name of the method.
        args: Arguments by position.
    """

    seq: int
    name: str
    args: tuple[Any, ...]


KEPT: dict[tuple[str, str], Callable[[Any], Any]] = {  # what is kept of an argument, by method and name
    ("in_time", "command"): lambda _: None,
    ("receive_reference", "rows"): lambda _: None,
    ("retune", "ocp"): lambda ocp: {name: getattr(ocp, name) for name in WEIGHTS_AND_BOUNDS},
}


def encode_call(call: Call) -> bytes:
    """
    Return the bytes of one entry.

    Raises:
        JournalError: The method or an argument is none that an entry can hold.
    """
    if (place := PLACES.get(call.name)) is None:
        raise JournalError(f"a call in a journal must be one of {', '.join(NAMES)}, got {call.name}")
    names = METHODS[call.name]
    content = bytearray((place,))
    args = [*call.args, *(call.kwargs.get(name) for name in names[len(call.args) :])]
    for name, value in zip(names, args, strict=True):
        keep = KEPT.get((call.name, name))
        encode_value(value if keep is None else keep(value), content)
    return bytes(content)


def join_entries(entries: Iterable[bytes]) -> bytes:
    """Return the bytes of consecutive entries, for one message."""
    return bytes((ENCODING_VERSION,)) + b"".join(entries)


def decode_entries(content: bytes, seq: int) -> Iterator[JournalEntry]:
    """
    Yield the entries of one message.

    Args:
        content: Its bytes.
        seq: Number of the first entry.

    Raises:
        JournalError: The bytes are none.
    """
    check_version(content)
    decoder = Decoder(content, 1)
    while not decoder.done:
        name = at(NAMES, decoder.take(1)[0])
        yield JournalEntry(seq, name, tuple(decoder.value() for _ in METHODS[name]))
        seq += 1
