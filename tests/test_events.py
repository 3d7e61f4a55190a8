# SPDX-License-Identifier: Apache-2.0
"""Table of events in the documentation, held against every event code in the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "events.md").read_text(encoding="utf-8")
CODE = re.compile(r"[a-z]+(_[a-z]+)*")
SAYS = {"Notice", "say", "_say", "_note", "_tell", "enter"}  # every function that takes an event code
REASONS = {"_objection", "unfit", "accept"}  # functions that return why a command is refused: the second half of `command_...`


@cache
def trees() -> list[ast.Module]:
    """Return the sources, parsed."""
    return [ast.parse(path.read_text(encoding="utf-8")) for folder in ("rti_mpc", "service", "sim") for path in sorted((ROOT / folder).rglob("*.py"))]


def named(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def constants(node: ast.AST) -> Iterator[str]:
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            yield inner.value


def codes() -> Iterator[str]:
    """Codes that stand in the source as they are sent."""
    for tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and named(node.func) in SAYS:
                arguments = node.args[3:] if named(node.func) == "enter" else node.args  # a mode, its reason and severity come first
                yield from (
                    text for argument in arguments if isinstance(argument, ast.Constant) for text in constants(argument) if CODE.fullmatch(text)
                )
            elif (
                isinstance(node, ast.Tuple)
                and len(node.elts) == 3
                and isinstance(node.elts[0], ast.Attribute)
                and named(node.elts[0].value) == "Arrival"
            ):
                yield from (text for text in constants(node.elts[1]) if text)


def reasons() -> Iterator[str]:
    """Reasons for which guard and robot refuse a command."""
    for tree in trees():
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and function.name in REASONS:
                for statement in function.body[1:]:
                    for text in constants(statement):
                        if (match := re.fullmatch(rf"({CODE.pattern})(: .*)?", text)) is not None:
                            yield match[1]


def documented() -> set[str]:
    return {code for cell in re.findall(r"^\| (`[^|]*) \|", PAGE, re.MULTILINE) for code in re.findall(r"`(\w+)`", cell)}


def test_every_event_code_in_the_source_is_in_the_table_of_events() -> None:
    found = {*codes(), "mode"}  # a change of mode without a code of its own
    assert {"took_over", "clock_known", "robot_restarted", "latch_refused", "stop_stored"} <= found, "the search has lost what it is known to find"
    assert found - documented() == set()


def test_every_reason_to_refuse_a_command_is_in_the_table_of_events() -> None:
    found = {f"command_{reason}" for reason in set(reasons()) - {"source_changed", "source_refused"}}
    assert {"command_fenced", "command_stale", "command_early", "command_not_finite", "command_expired"} <= found
    assert found - documented() == set()


def test_the_table_of_events_names_no_code_that_the_source_has_not() -> None:
    source = {text for tree in trees() for text in constants(tree)}
    for code in documented():
        assert code in source or any(text == code.partition("_")[2] or text.startswith(code.partition("_")[2] + ":") for text in source), code
