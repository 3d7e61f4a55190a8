# SPDX-License-Identifier: Apache-2.0
"""Commands of `rti-mpc` in the process of the test: a process of their own needs a second to load what the tests have loaded long ago."""

from __future__ import annotations

import os
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from io import StringIO
from subprocess import CompletedProcess
from typing import Any
from unittest import mock

import typer

from rti_mpc_service.cli import app
from rti_mpc_service.entry import status_of


@cache
def built() -> Any:
    """All commands, with their options, which Typer would read from their signatures at each call."""
    return typer.main.get_command(app)


def command(*arguments: object, columns: int = 200) -> CompletedProcess[str]:
    """Run a command, and return its exit status and what it prints; its log aside, as `rti_mpc_service.cli.main`."""
    words, printed, said = [str(argument) for argument in arguments], StringIO(), StringIO()
    with mock.patch.dict(os.environ, COLUMNS=str(columns)), redirect_stdout(printed), redirect_stderr(said):
        status = status_of((lambda: built()(words),))
    return CompletedProcess(words, status, printed.getvalue(), said.getvalue())
