# SPDX-License-Identifier: Apache-2.0
"""
Maker of a recording: the version of rti-mpc, its build and its machine, as attached, beside those that are here.

Where other code of rti-mpc made it, whatever does not fit is told by that in one line:
an entry, a snapshot, a configuration, the equations of a model, the guess of a case.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import rti_mpc
from rti_mpc.codegen import BUILDS, flags_of
from rti_mpc.errors import ConfigError, RtiMpcError
from rti_mpc.wire import document
from rti_mpc_service.host import machine
from rti_mpc_service.origin import CHECKOUT, code_hash

VERSIONS = "versions.json"  # name of the attached file
MAX_VERSIONS_BYTES = 1 << 20
HASH_CHARS = 12  # of a hash that is told
MISFITS = (RtiMpcError, AttributeError, IndexError, KeyError, TypeError, ValueError)  # from objects that other code would have made otherwise


def versions(files: Mapping[str, str]) -> dict[str, Any]:
    """Return what the attached files say of versions, build and machine; nothing where they do not."""
    return document.read(files.get(VERSIONS, "{}").encode(), most=MAX_VERSIONS_BYTES)


def other_code(files: Mapping[str, str]) -> str:
    """Return in words by which other code of rti-mpc a recording was made; empty if by this one, or if it does not say."""
    recorded, here = versions(files), code_hash()
    code = recorded.get("code_sha256")
    if code in (None, here):
        return ""
    return f"rti-mpc {_named(recorded)} of the code {str(code)[:HASH_CHARS]}, this is {_here()} of the code {here[:HASH_CHARS]}"


def _named(recorded: Mapping[str, Any]) -> str:
    """Return the version, with the commit where it was a checkout."""
    version, commit = recorded.get("rti_mpc"), recorded.get("commit")
    return f"{version} (commit {commit})" if commit else f"{version}"


def _here() -> str:
    return _named({"rti_mpc": rti_mpc.__version__, "commit": machine.commit(CHECKOUT)})


@contextmanager
def fitting(files: Mapping[str, str]) -> Iterator[None]:
    """
    Let what does not fit be told by the version that made it, if other code did.

    Args:
        files: Files that are attached for a controller, a text by name.

    Raises:
        ConfigError: Something did not fit, and other code made it. Without other code, what was raised is left as it is.
    """
    try:
        yield
    except MISFITS as error:
        if not (other := other_code(files)):
            raise
        reason = str(error) if isinstance(error, RtiMpcError) else f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"the recording was made by {other}, and does not fit this one; use the one that made it. What does not fit: {reason}"
        ) from error


def changes(recorded: Mapping[str, Any]) -> Iterator[str]:
    """Yield what was another when a controller was recorded, a line each."""
    if not recorded:
        yield "the recording does not say with what it was made"
        return
    if recorded.get("code_sha256") != code_hash():
        yield f"recorded with other code of rti-mpc than that of this {_here()}: {_named(recorded)}"
    compiler = shutil.which("cc") or "CasADi's virtual machine"
    if recorded.get("build") not in [[compiler, *flags_of(build)] for build in BUILDS]:  # which of them, the configuration says
        yield f"recorded with another build: {recorded.get('build')}"
    then, here = recorded.get("machine") or {}, machine.machine_info()
    for what in ("processor", "system", "python", "packages"):
        if then.get(what) != here[what]:
            yield f"recorded with another {what.removesuffix('s')}: {then.get(what)}, here {here[what]}"
