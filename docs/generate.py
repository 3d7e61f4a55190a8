# SPDX-License-Identifier: Apache-2.0
"""Generated pages of the documentation site: configuration, messages, command line, Python reference, and those kept in deploy/."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mkdocs_gen_files
import typer.main

from rti_mpc.wire.cdr import encoding
from rti_mpc.wire.layout import LAYOUTS, MESSAGE_DESCRIPTIONS, msg_text
from rti_mpc.wire.streams import STREAMS, Kind, Stream
from rti_mpc_service.cli import app
from rti_mpc_service.config.schema import Config

ROOT = Path(__file__).parents[1]


def write(name: str, *lines: str) -> None:
    """Write one page."""
    with mkdocs_gen_files.open(name, "w") as page:
        page.write("\n".join(lines) + "\n")


def kept(name: str) -> str:
    """Return a page kept in deploy/, with its links as seen from the site."""
    text = (ROOT / "deploy" / name).read_text(encoding="utf-8")
    return re.sub(r"\]\(\.\./docs/", "](", text)


def configuration() -> Iterator[str]:
    """Yield the page of the robot's TOML file."""
    schema = Config.model_json_schema()
    yield from (
        "# Configuration",
        "",
        "One TOML file per robot, as `rti-mpc schema` describes it for editors. Unknown keys are refused, with the nearest known one.",
    )
    yield from table("top level", schema, schema)
    for header, reference, description in tables(schema, schema):
        yield from ("", f"## `{header}`", "", description.capitalize() + ".", *table(header, reference, schema))


def tables(section: dict[str, Any], schema: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield header, schema and description of every table below one; `NAME` stands for the names of tables that are by name."""
    for name, field in section["properties"].items():
        for reference in references(field):
            inner = schema["$defs"][reference]
            if "properties" in inner:
                key = f"{prefix}{name}.NAME" if "additionalProperties" in field else f"{prefix}{name}"
                yield f"[[{key}]]" if field.get("type") == "array" else f"[{key}]", inner, field.get("description", inner.get("description", ""))
                yield from tables(inner, schema, f"{key}.")


def references(field: dict[str, Any]) -> list[str]:
    """Return the names of the definitions a field refers to."""
    return re.findall(r"#/\$defs/(\w+)", str(field))


def table(key: str, section: dict[str, Any], schema: dict[str, Any]) -> Iterator[str]:
    """Yield the rows of one table."""
    yield from ("", "| key | type | default | meaning |", "| --- | --- | --- | --- |")
    for name, field in section["properties"].items():
        if any("properties" in schema["$defs"][reference] for reference in references(field)):
            continue
        default = "required" if name in section.get("required", ()) else f"`{field['default']}`" if field.get("default") is not None else ""
        yield f"| `{name}` | {kind(field)} | {default} | {field.get('description', '')} |".replace("\n", " ")


def kind(field: dict[str, Any]) -> str:
    """Return the type of a field in words."""
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(kind(option) for option in field["anyOf"] if option.get("type") != "null"))
    if "enum" in field:
        return " or ".join(f"`{value}`" for value in field["enum"])
    if "const" in field:
        return f"`{field['const']}`"
    words = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false", "array": "list", "object": "table"}
    limits = [f"{word} {field[name]:g}" for name, word in LIMITS.items() if name in field and isinstance(field[name], int | float)]
    return " ".join([words.get(field.get("type", ""), "value"), *limits])


LIMITS = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}


def messages() -> Iterator[str]:
    """Yield the page of the messages."""
    yield from (
        "# Messages",
        "",
        "CDR, little-endian with its four-byte header, as the `.msg` files in `deploy/msg` define; every stamp is nanoseconds of the robot's clock.",
    )
    yield from (
        "",
        "## Streams",
        "",
        "Keys lie below `<prefix>/<robot>/`, by default `rti_mpc/<robot>/`; `<role>` is that of the publisher.",
        "`relay` and `echo` take part in fault injection and measurements alone.",
    )
    yield from (
        "",
        "| key | what | message | published, or answered, by | how often | quality of service | largest |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    )
    for stream in STREAMS:
        key = f"{stream.name}/<role>" if stream.by_role else stream.name
        roles = ", ".join(f"`{role}`" for role in stream.publishers)
        kind = f"[`{stream.message.__name__}`](#{stream.message.__name__.lower()})" if stream.message else FORMS[stream.kind]
        size = f"{stream.max_bytes:,} bytes" if stream.max_bytes else ""
        yield f"| `{key}` | {stream.about} | {kind} | {roles} | {stream.rate} | {service(stream)} | {size} |"
    for cls in LAYOUTS:
        yield from ("", f"## {cls.__name__}", "", MESSAGE_DESCRIPTIONS[cls], "", f"Encoding `{encoding(cls)}`.", "")
        yield from ("```text", msg_text(cls).rstrip(), "```")


FORMS = {Kind.MESSAGE: "JSON", Kind.QUERY: "query, JSON", Kind.TOKEN: "liveliness token"}


def service(stream: Stream[Any]) -> str:
    """Return the quality of service of a stream in words."""
    if stream.kind is Kind.TOKEN:
        return ""
    qos = stream.qos
    words = [f"`{qos.priority}`", f"`{qos.congestion}`", *(["express"] if qos.express else []), *(["cached for late joiners"] if qos.cached else [])]
    return ", ".join(words)


def command_line() -> Iterator[str]:
    """Yield the page of the command line."""
    yield from ("# Command line", "", "Options of Zenoh keep Zenoh's names; those of Rerun begin with `--rerun-`.")
    for name, command in typer.main.get_group(app).commands.items():
        yield from ("", f"## `rti-mpc {name}`", "", command.help or "", "", "| option | meaning |", "| --- | --- |")
        for parameter in command.params:
            names = ", ".join(f"`{option}`" for option in (*parameter.opts, *parameter.secondary_opts))
            yield f"| {names} | {getattr(parameter, 'help', '')} |".replace("\n", " ")


def python() -> Iterator[str]:
    """Yield the page of the Python reference, module by module, with sources."""
    yield from ("# Python", "", "The public names are those of `rti_mpc`; everything below is where they come from.", "")
    for path in sorted((ROOT / "rti_mpc").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        yield from (f"::: {module}", "")


write("reference/configuration.md", *configuration())
write("reference/messages.md", *messages())
write("reference/cli.md", *command_line())
write("reference/python.md", *python())
write("runbook.md", kept("runbook.md"))
write("guard.md", kept("guard.md"))
