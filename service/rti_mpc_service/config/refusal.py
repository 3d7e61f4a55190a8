# SPDX-License-Identifier: Apache-2.0
"""Refusals of a configuration, one line each: the key, what must hold, what was got, and what was probably meant."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from rti_mpc.model.model import Signal

MAX_QUOTED_CHARACTERS = 200  # of a value in a refusal
NAME = "NAME"  # in keys of the tree: any name
TABLE, LIST = "must be a table, such as { name = 1.0 }", "must be a list"

# Patterns in Pydantic's messages, and the wording for a TOML file.
REWORDINGS = (
    (r"^Value error, ", ""),
    (r"^(Input|String) should ", "must "),
    (r"^must be a valid dictionary.*", TABLE),
    (r"^must be a valid tuple", LIST),
    (r"be a valid string", "be text"),
    (r"be a valid integer", "be a whole number"),
    (r"be a valid number", "be a number"),
    (r"be a valid boolean", "be true or false"),
    (r"greater than or equal to", "at least"),
    (r"less than or equal to", "at most"),
    (r"match pattern .*", "be written so"),  # as its description says
)


def explain(error: ValidationError, tree: type[BaseModel], document: Mapping[str, Any]) -> str:
    """Return one complaint about a document as text; an unknown key comes first, since it is often the reason why another one is missing."""
    complaints = sorted(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")
    complaint, keys = complaints[0], dict(entries(tree))
    got, missing = complaint["input"], complaint["type"] == "missing"
    loc = complaint["loc"] if missing else written(complaint["loc"], document)
    key, what = dotted(loc), description_of(loc, keys)
    if complaint["type"] == "extra_forbidden":
        return f"{key} is unknown, {suggestion(loc, keys)}, got {quoted(got)}"
    if missing:
        return f"{key} is missing: {what}"
    first, *others = (reworded(one["msg"]) for one in complaints if written(one["loc"], document) == loc)  # one for each kind of value that it may be
    must = " or ".join((first, *(other.removeprefix("must be ") for other in others)))
    if must in (TABLE, LIST) and (inside := keys_of(loc, keys)):
        must = f"{TABLE.partition(',')[0]} {inside}" if must == TABLE else f"{LIST} of tables, each {inside}: [[{key}]]"
    return f"{key} ({what}) {must}, got {quoted(got)}"


def written(loc: tuple[int | str, ...], document: Any) -> tuple[int | str, ...]:
    """Return the part of a location that is in the document: Pydantic adds the kind of a value, and the place of a number that stands for a list."""
    for n, step in enumerate(loc):
        if not (step in document if isinstance(document, Mapping) else isinstance(document, list | tuple)):
            return loc[:n]
        document = document[step]
    return loc


def reworded(message: str) -> str:
    """Return a message of Pydantic's in the words of a TOML file."""
    for pattern, words in REWORDINGS:
        message = re.sub(pattern, words, message)
    return message


def quoted(value: object) -> str:
    """Return a value as text of bounded length."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTED_CHARACTERS else f"{text[:MAX_QUOTED_CHARACTERS]}..."


def unknown_name(key: str, table: Mapping[str, object], kind: str, signals: Sequence[Signal], *, complete: bool) -> str | None:
    """
    Return what is wrong with the names of a table, None if they are right.

    Args:
        key: The table's key.
        table: Values by name.
        kind: What the names stand for, such as ``"state"``.
        signals: Signals of the model.
        complete: Whether the table must name each of them.
    """
    units = {signal.name: f"{signal.name} [{signal.unit}]" for signal in signals}
    for name, got in table.items():
        if name not in units:
            return f"{key}.{name} is {unknown_signal(name, kind, signals)}, got {quoted(got)}"
    missing = [unit for name, unit in units.items() if complete and name not in table]
    return f"{key} must name every {kind} of the model, {missing[0]} is missing, got {quoted(dict(table))}" if missing else None


def unknown_signal(name: str, kind: str, signals: Sequence[Signal]) -> str:
    """Return what a name is instead of that of a signal: `no state of the model`, and what was probably meant."""
    units = {signal.name: f"{signal.name} [{signal.unit}]" for signal in signals}
    near = [units[n] for n in get_close_matches(name, units, 1)]
    return f"no {kind} of the model, {f'perhaps {near[0]} is meant' if near else list_known(units.values())}"


def entries(tree: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield every key of a tree with its description, depth first; `NAME` stands for the names of tables that are by name."""
    for name, field in tree.model_fields.items():
        key = prefix + (field.alias or name)
        yield key, field.description or ""
        for inside in (field.annotation, *get_args(field.annotation)):  # a table, one that may be left out, or a list of tables
            if isinstance(inside, type) and issubclass(inside, BaseModel):
                yield from entries(inside, f"{key}.{NAME}." if get_origin(field.annotation) is dict else f"{key}.")


def dotted(loc: Sequence[int | str]) -> str:
    """Write a location as the file's reader would: ``bus.listen[0]``."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in loc).removeprefix(".")


def tree_key(loc: Sequence[int | str], tree: Mapping[str, str]) -> str:
    """Return a location as a key of the tree: without indices of lists, and with `NAME` for the names of tables that are by name."""
    key = ""
    for step in loc:
        if isinstance(step, str):
            named = any(other.startswith(f"{key}.{NAME}.") for other in tree)
            key = f"{key}.{NAME if named else step}".removeprefix(".")
    return key


def keys_of(loc: Sequence[int | str], tree: Mapping[str, str]) -> str:
    """Return which keys a table has, in words; empty if it is one of values by name."""
    below = f"{tree_key(loc, tree)}."
    names = [key.removeprefix(below) for key in tree if key.startswith(below)]
    if any(name.startswith(f"{NAME}.") for name in names):
        return "of tables by name, each " + keys_of((*loc, NAME), tree)
    own = [name for name in names if "." not in name]
    return f"with {', '.join(own)}" if own else ""


def description_of(loc: Sequence[int | str], tree: dict[str, str]) -> str:
    """Return the description of the innermost key that has one."""
    return next((tree[key] for n in range(len(loc), 0, -1) if (key := tree_key(loc[:n], tree)) in tree), "")


def suggestion(loc: Sequence[int | str], tree: dict[str, str]) -> str:
    """Return the same key in another table, else the most similar key of the same table, else all keys of that table."""
    section, _, name = tree_key(loc, tree).rpartition(".")
    beside = {other.rpartition(".")[2]: other for other in tree if other.rpartition(".")[0] == section}
    near = [other for other in tree if other.rpartition(".")[2] == name]
    near += [other for n, other in beside.items() if n.lower() == name.lower()] + [beside[n] for n in get_close_matches(name, beside, 1)]
    if not near:
        return list_known(beside)
    key = next((dotted((*loc[:-1], n)) for n, other in beside.items() if other == near[0]), near[0])  # with the index of a table in a list
    return f"perhaps {key} is meant ({tree[near[0]]})"


def list_known(names: Iterable[str]) -> str:
    """Return a list of known names as text."""
    return f"known: {', '.join(names) or 'none'}"
