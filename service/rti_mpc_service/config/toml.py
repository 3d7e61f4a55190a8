# SPDX-License-Identifier: Apache-2.0
"""TOML: reading with a limit on nesting and advice on common slips, and writing a configuration, so that a run can store its own."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rti_mpc.errors import ConfigError
from rti_mpc.given import quoted

if TYPE_CHECKING:
    from rti_mpc_service.config.schema import Config

MAX_NESTING = 16  # levels of tables and lists inside each other; a configuration has five
POSITION = re.compile(r" \(at (line (\d+), column \d+)\)$")  # at the end of the parser's words

# Slips, as they are common in other formats, and what TOML has there: the parser's words tell only where it gave up.
SLIPS = (
    (r"^Cannot (declare|overwrite)", "each key and each table stands once"),  # this one in the parser's words, all others in the line
    (r"=\s*[-+]?\d+,\d", "decimals take a point, as in 0.5"),
    (r"=\s*[-+]?(\.\d|\d+\.(?!\d))", "a number has a digit on both sides of its point"),
    (
        r"=\s*(?!(?:true|false)\b)(?i:true|false|yes|no|on|off|none|null)(?![\w-])",
        "a switch is true or false, in small letters, and a key without a value is left out",
    ),
    (r"=\s*\(", "a list is in square brackets"),
    (r"\{[^}]*$", "a table in braces ends on the line on which it begins"),
    (r",\s*\}", "a table in braces has no comma at its end"),
    (r"""^[^"'=]*=\s*(["'])(?!.*\1)""", "text ends with the quote with which it began"),
    (r"=\s*[-+]?(?!(?:inf|nan)\b)(?i:inf|infinity|nan)\b", "infinity is inf and no number is nan, in small letters"),
    (r"=\s*(?!(?:true|false|inf|nan)\b)[^\W\d]|[\u2018-\u201f]", "text is in straight quotes"),
    (r"=\s*[-+]?\d[\d.]*(?:\s+|(?![_eEbox]))[^\W\d]", "a number has no unit"),
    (r"^\s*[\w.-]+\s*:", "a key and its value are joined by ="),
)


def read(text: str) -> dict[str, Any]:
    """
    Return the content of TOML.

    Raises:
        ConfigError: The text is not TOML, or nested deeper than `MAX_NESTING`.
    """
    try:
        content = tomllib.loads(text)
    except ValueError as error:  # of a number with thousands of digits, too
        raise ConfigError(f"must be TOML, got {located(str(error), text)}") from None
    except RecursionError:
        content = None
    if content is None or too_deep(content):
        raise ConfigError(f"must be TOML of at most {MAX_NESTING} tables and lists inside each other")
    return content


def located(complaint: str, text: str) -> str:
    """Return a complaint of the parser with the line that it is about, and advice on it."""
    if (position := POSITION.search(complaint)) is None:
        return complaint
    place, number = position.groups()
    words, line = complaint[: position.start()], text.split("\n")[int(number) - 1]
    content = line.partition("#")[0].strip() or line.strip()
    return f"{quoted(content)} at {place}{advice(words) or advice(content) or f': {words}'}"


def advice(text: str) -> str:
    """Return what TOML has in place of a slip, to be appended; empty if none is known."""
    return next((f": {rule}" for slip, rule in SLIPS if re.search(slip, text)), "")


def read_value(text: str) -> Any:
    """
    Return one value, such as the right side of an assignment on the command line.

    Raises:
        ConfigError: The text is not one value of TOML.
    """
    try:
        (value,) = read(f"value = {text}").values()
    except (ConfigError, ValueError):  # the latter of text that goes on with another key
        raise ConfigError(f"must be a value as in the file, got {text}") from None
    return value


def too_deep(content: dict[str, Any]) -> bool:
    """Whether more than `MAX_NESTING` tables and lists are inside each other."""
    level: list[Any] = [content]
    for _ in range(MAX_NESTING):
        tables = [value for value in level if isinstance(value, dict | list)]
        level = [inner for table in tables for inner in (table.values() if isinstance(table, dict) else table)]
    return any(isinstance(value, dict | list) for value in level)


def write(config: Config, *, without: Mapping[str, Any] | None = None) -> str:
    """Return the text of a file that loads as this configuration; keys that were left out stay out, and those of `without`, as pydantic has it."""
    content = config.model_dump(mode="python", by_alias=True, exclude_unset=True, exclude_none=True, exclude=dict(without or {}))
    return "\n".join(_table("", content)).strip() + "\n"


def _table(path: str, values: Mapping[str, Any]) -> list[str]:
    """Return the lines of a table: its own keys, then the tables below it."""
    below = {name: value for name, value in values.items() if isinstance(value, dict)}
    own = [f"{_key(name)} = {text(value)}" for name, value in values.items() if name not in below]
    lines = ["", f"[{path}]", *own] if path and (own or not below) else own
    for name, value in below.items():
        lines += _table(f"{path}.{_key(name)}" if path else _key(name), value)
    return lines


def _key(name: str) -> str:
    """Return a bare key where TOML allows it."""
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else _quoted(name)


def _quoted(value: str) -> str:
    """Return text as a string of TOML, which knows JSON's escapes, but neither pairs of surrogates nor a bare DEL; what is no text becomes ``?``."""
    return json.dumps(value.encode(errors="replace").decode(), ensure_ascii=False).replace("\x7f", r"\u007f")


def text(value: Any) -> str:
    """Return a value as TOML; scalars are as in JSON, except infinities and types that JSON lacks."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{_key(name)} = {text(inner)}' for name, inner in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(text, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value) if isinstance(value, bool | int | float) else _quoted(str(value))
