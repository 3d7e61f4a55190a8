# SPDX-License-Identifier: Apache-2.0
"""
Edit of values in the text of a TOML file, which keeps everything else, comments too.

The text is not parsed here. Each place where the key might stand is tried, and the one
after which the file reads as it should is right.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping
from typing import Any

from rti_mpc.errors import ConfigError
from rti_mpc_service.config import toml

NUMBER = r"[-+]?[0-9][0-9_]*(?:\.[0-9_]+)?(?:[eE][-+]?[0-9]+)?"


def edited(text: str, values: Mapping[str, float]) -> str:
    """
    Return the text of a file with other values.

    Args:
        text: TOML.
        values: Numbers by dotted key; a key that the file leaves out is added.

    Raises:
        ConfigError: A key is written in a way that this cannot change.
    """
    for key, value in values.items():
        wanted = changed(toml.read(text), key, value)
        for candidate in candidates(text, key, toml.text(value)):
            if reads_as(candidate, wanted):
                text = candidate
                break
        else:
            raise ConfigError(f"{key} must be written as a plain number in the file, so that it can be changed there")
    return text


def changed(document: dict[str, Any], key: str, value: float) -> dict[str, Any]:
    """Return what a file must read as with another value."""
    document = copy.deepcopy(document)
    *tables, name = key.split(".")
    place = document
    for table in tables:
        place = place.setdefault(table, {})
    place[name] = value
    return document


def candidates(text: str, key: str, value: str) -> Iterator[str]:
    """Yield texts, one of which has the value at the key: each place with that name changed, or the key added to its table."""
    table, _, name = key.rpartition(".")
    for match in re.finditer(rf"""(?<![\w-])(["']?){re.escape(name)}\1\s*=\s*(\[\s*)?({NUMBER})(?(2)\s*\])""", text):
        if match[2]:  # a list of one number
            yield text[: match.start(2)] + value + text[match.end() :]
        else:
            yield text[: match.start(3)] + value + text[match.end(3) :]
    for match in re.finditer(rf"^[ \t]*\[[ \t]*{re.escape(table)}[ \t]*\].*\n?", text, re.MULTILINE):
        yield f"{text[: match.end()].rstrip()}\n{name} = {value}\n{text[match.end() :]}"
    yield f"{text.rstrip()}\n\n[{table}]\n{name} = {value}\n"


def reads_as(text: str, wanted: dict[str, Any]) -> bool:
    """Whether a text is TOML with this content."""
    try:
        return toml.read(text) == wanted
    except ConfigError:
        return False


def commented(text: str, lines: list[str]) -> str:
    """Return a text with a comment below the comment it begins with."""
    own = text.splitlines(keepends=True)
    head = next((i for i, line in enumerate(own) if not line.startswith("#")), len(own))
    return "".join([*own[:head], "#\n" if head else "", *(f"# {line}\n" for line in lines), *([] if head else ["\n"]), *own[head:]])
