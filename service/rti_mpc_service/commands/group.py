# SPDX-License-Identifier: Apache-2.0
"""Group of commands of the command line."""

from __future__ import annotations

import sys
from typing import Any

from typer.core import TyperGroup


class Commands(TyperGroup):
    """Group whose list of commands shows whole sentences, wrapped on narrow terminals, where Click would cut them off."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        rows = [(name, self.commands[name].get_short_help_str(limit=sys.maxsize)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(rows)
