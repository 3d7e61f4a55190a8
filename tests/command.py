# SPDX-License-Identifier: Apache-2.0
"""Commands of `rti-mpc` in the process of the test: a process of their own needs a second to load what the tests have loaded long ago."""

from __future__ import annotations

import os
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from subprocess import CompletedProcess
from unittest import mock

from rti_mpc_service.cli import app
from rti_mpc_service.entry import status_of


def command(*arguments: object, columns: int = 200) -> CompletedProcess[str]:
    """Run a command, and return its exit status and what it prints; its log aside, as `rti_mpc_service.cli.main`."""
    words, printed, said = [str(argument) for argument in arguments], StringIO(), StringIO()
    with mock.patch.dict(os.environ, COLUMNS=str(columns)), redirect_stdout(printed), redirect_stderr(said):
        status = status_of((lambda: app(words),))
    return CompletedProcess(words, status, printed.getvalue(), said.getvalue())
