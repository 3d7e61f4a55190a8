# SPDX-License-Identifier: Apache-2.0
"""
Expressions as modellers write them, made into columns of CasADi's SX, which all of the library is built from.

Lists of components are stacked. MX is expanded: do-mpc and acados models are often
written in it, and it means the same as long as SX has its operations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc import given
from rti_mpc.errors import OcpError

Expression = Any  # SX or MX; CasADi has no types


def to_sx(symbols: Mapping[str, Any], expressions: Mapping[str, Any]) -> dict[str, ca.SX]:
    """
    Return symbols and expressions of them, by name, in SX.

    Args:
        symbols: Those that the expressions may depend on: SX or MX, or lists of their components.
        expressions: SX, MX, numbers, or lists of them.

    Raises:
        OcpError: One is no expression, symbols are none or are there twice, SX and MX are mixed, or MX has no counterpart in SX.
    """
    columns = {name: column(name, value) for name, value in {**symbols, **expressions}.items()}
    check_symbols({name: columns[name] for name in symbols})
    if not any(isinstance(value, ca.MX) for value in columns.values()):
        return columns
    for name, value in columns.items():
        if isinstance(value, ca.SX):
            if not value.is_constant():
                raise OcpError(f"{name} must be MX like the others, or all of them SX, got {given.quoted(value)}")
            columns[name] = ca.MX(ca.DM(value))
    return expanded(columns, list(symbols))


def to_text(columns: Mapping[str, ca.SX]) -> str:
    """Return columns that share symbols as text from which `from_text` makes them again; for pickles, since CasADi's own are of one expression."""
    serializer = ca.StringSerializer()
    serializer.pack(list(columns.values()))
    return str(serializer.encode())


def from_text(names: Iterable[str], text: str) -> dict[str, ca.SX]:
    """Return the columns of `to_text` by name, in its order, in symbols of their own."""
    return dict(zip(names, ca.StringDeserializer(text).unpack(), strict=True))


def column(name: str, value: Any) -> Expression:
    """
    Return one expression, its components stacked if it is a list of them.

    Raises:
        OcpError: It is none.
    """
    if isinstance(value, ca.SX | ca.MX):
        return value
    parts = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(parts, list | tuple) and any(isinstance(part, ca.SX | ca.MX) for part in parts):
        try:
            return ca.vertcat(*parts)
        except (NotImplementedError, RuntimeError):
            raise OcpError(f"{name} must be a list of numbers and of either SX or MX, got {given.quoted(parts)}") from None
    try:
        return ca.SX(ca.DM(given.numbers(name, value)))
    except OcpError:
        raise OcpError(f"{name} must be an expression of CasADi's, SX or MX, or a list of its components, got {given.quoted(value)}") from None


def check_symbols(symbols: Mapping[str, Expression]) -> None:
    """
    Check that symbols are there once each.

    Raises:
        OcpError: One is an expression, or there twice.
    """
    owners: dict[int, str] = {}
    for name, value in symbols.items():
        found = ca.symvar(value)
        if not value.is_valid_input() or sum(symbol.numel() for symbol in found) != value.numel():
            raise OcpError(f"{name} must consist of symbols, each there once, such as SX.sym({name!r}, n), got {given.quoted(value)}")
        for symbol in found:
            if (owner := owners.setdefault(symbol.__hash__(), name)) != name:
                raise OcpError(f"{name} must consist of symbols of its own, got {symbol}, which is in {owner} too")


def expanded(columns: Mapping[str, ca.MX], symbols: list[str]) -> dict[str, ca.SX]:
    """
    Return symbols of SX, and what expressions in MX are in them.

    Raises:
        OcpError: An expression depends on something else, or has no counterpart in SX.
    """
    known = ca.symvar(ca.veccat(*(columns[name] for name in symbols)))
    replaced = {name: ca.SX.sym(name, *columns[name].shape) for name in symbols}
    for name, value in columns.items():
        if name in symbols:
            continue
        if free := [str(symbol) for symbol in ca.symvar(value) if not any(ca.is_equal(symbol, k) for k in known)]:
            raise OcpError(f"{name} must depend only on {', '.join(symbols)}, also has {', '.join(free)}")
        try:
            function = ca.Function(name, [columns[symbol] for symbol in symbols], [value]).expand()
        except Exception as error:
            reason = str(error).strip().splitlines()[-1]
            hint = ", for which solve(A, b, 'symbolicqr', {}) can stand" if "Linsol" in reason else ""
            raise OcpError(
                f"{name} must be SX, or MX of operations that SX has too, no external function or integrator, got {reason}{hint}"
            ) from None
        replaced[name] = function(*(replaced[symbol] for symbol in symbols))
    return replaced
