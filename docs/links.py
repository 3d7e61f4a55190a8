# SPDX-License-Identifier: Apache-2.0
"""Links of the documentation site: those into the source tree lead to the Python reference, or become plain text."""

from __future__ import annotations

import re
from typing import Any

REPOSITORY = re.compile(r"\[([^\]]*)\]\((\.\./[^)#]*)(#[^)]*)?\)")
LIBRARY = re.compile(r"\.\./(rti_mpc/[\w/]+)\.py")
INSIDE = re.compile(r"\.\./docs/([\w./]+)")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Rewrite the links of one page."""
    return REPOSITORY.sub(lead, markdown)


def lead(link: re.Match[str]) -> str:
    """Return where a link into the repository leads on the site."""
    text, target, anchor = link.groups()
    if (page := INSIDE.fullmatch(target)) is not None:
        return f"[{text}]({page[1]}{anchor or ''})"
    if (module := LIBRARY.fullmatch(target)) is not None:
        return f"[{text}](reference/python.md#{module[1].replace('/', '.')})"
    return text
