# SPDX-License-Identifier: Apache-2.0
"""
Division of generated code into translation units, so that the compiler never holds all of it.

A stage of many states is one function of thousands of statements without a loop. Such a
function is a unit of its own, which its callers could not inline anyway, and is spared the
passes that look for what CasADi has left in it: common expressions, of which there are none.
"""

from __future__ import annotations

import re

LONG = 1000  # lines from which a function without loops is a unit of its own
FEWER_PASSES = ("-O2", "-fno-tree-pre", "-fno-code-hoisting", "-fno-gcse")  # for these, if the compiler knows them: half of the time

FUNCTION = re.compile(r"^/\* (?P<name>\w+):\(.*\*/\nstatic (?P<head>int (?P<symbol>\w+)\(.*\)) \{\n(?P<body>(?:.*\n)*?)\}\n", flags=re.MULTILINE)
LOOP_OR_CALL = re.compile(r"for \(|casadi_f\d")
HELPER = re.compile(r"^(?=(?:void|int|casadi_\w+) casadi_\w+\()", flags=re.MULTILINE)
READ = re.compile(r"\barg\[(?P<of>\d+)\]\? arg\[(?P=of)\]\[(?P<at>\d+)\] : 0;")
WITHIN_THE_LIBRARY = '__attribute__((visibility("hidden"))) '


def units(source: str) -> list[str]:
    """Return the translation units of generated code: all of it but the long functions without loops, then each of these."""
    found = list(FUNCTION.finditer(source))
    alone = [match for match in found if match["body"].count("\n") >= LONG and not LOOP_OR_CALL.search(match["body"])]
    if not alone:
        return [source]
    before = "#define CASADI_SYMBOL_EXPORT static\n" + HELPER.sub("static ", source[: found[0].start()])
    rest, end = "", 0
    for match in alone:
        rest += f"{source[end : match.start()]}{WITHIN_THE_LIBRARY}{match['head']};\n"
        end = match.end()
    return [rest + source[end:], *(f"{before}{WITHIN_THE_LIBRARY}{match['head']} {{\n{read_at_once(match['body'])}}}\n" for match in alone)]


def read_at_once(body: str) -> str:
    """Let a function ask once, and not at each number, whether an argument is given; one that is not counts as zeros."""
    reads = list(READ.finditer(body))
    size = max((int(read["at"]) + 1 for read in reads), default=1)
    given = "".join(f"  const casadi_real* const arg_{i} = arg[{i}] ? arg[{i}] : none;\n" for i in sorted({int(read["of"]) for read in reads}))
    return f"  static const casadi_real none[{size}];\n" + given + READ.sub(r"arg_\g<of>[\g<at>];", body)
