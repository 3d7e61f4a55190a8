# SPDX-License-Identifier: Apache-2.0
"""A configuration as TOML again, so that a run leaves behind exactly what it was run with."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from service.config import Config


def write(config: Config) -> str:
    """Return the text of a file that loads as this configuration; what was left out stays out."""
    return "\n".join(_table("", config.model_dump(mode="python", by_alias=True, exclude_unset=True, exclude_none=True))).strip() + "\n"


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
    return name if name.isascii() and name.replace("_", "").replace("-", "").isalnum() else json.dumps(name)


def text(value: Any) -> str:
    """Return a value; JSON's text is TOML's but for infinities and what JSON lacks."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{_key(name)} = {text(inner)}' for name, inner in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(text, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value if isinstance(value, bool | int | float) else str(value))
