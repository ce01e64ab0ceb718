"""The report's sections on the run as a whole: the verdict, the orbit, the commands, and what to open."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from typing import Final
from urllib.parse import quote

from pop_fast.view.report.verdict import Finding

# a video that is larger than this is linked, not put into the report
_LARGEST: Final = 8 * 2**20
_SIGNS: Final = {"good": ("✓", "as it should be"), "look": ("!", "worth a look"), "bad": ("✗", "spoils the result")}
_UNCHECKED: Final = (
    "<p>Overfitting, exposure, floaters, depth and the orbit were not looked at; "
    "<code>pop report RESULT --check</code> does it, where the capture is.</p>"
)


def verdict_section(findings: Sequence[Finding], checked: bool) -> str:
    """Say how the run went."""
    if not findings and checked:
        return ""
    rows = "".join(
        f'<li class="{finding.kind}"><i title="{_SIGNS[finding.kind][1]}">{_SIGNS[finding.kind][0]}</i>'
        f"<b>{escape(finding.about)}</b><span>{escape(finding.text)}</span></li>"
        for finding in findings
    )
    return f'<h2>Verdict</h2>{"" if checked else _UNCHECKED}<ul class="verdict">{rows}</ul>'


def orbit_section(orbit: tuple[str, bytes] | None) -> str:
    """Show the orbit."""
    if orbit is None:
        return ""
    path, data = orbit
    about = "A turn about what the cameras look at, as far round as photographs were taken."
    if len(data) > _LARGEST:
        return f"<h2>The orbit</h2><p>{about} {_link(path, path)}, {len(data) / 1e6:.0f} MB.</p>"
    uri = f"data:video/webm;base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f"<h2>The orbit</h2><p>{about}</p>"
        f'<video class="orbit" controls loop muted playsinline aria-label="orbit" src="{uri}"></video>'
    )


def open_section(links: Sequence[tuple[str, str, int]]) -> str:
    """Link the files beside the report."""
    if not links:
        return ""
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{_link(path, path)}</td><td class=n>{_size(size)}</td></tr>"
        for name, path, size in links
    )
    return f'<h2>Beside this page</h2><div class="scroll"><table><tbody>{rows}</tbody></table></div>'


def command_section(commands: Sequence[tuple[str, str]]) -> str:
    """Give what was typed."""
    if not commands:
        return ""
    lines = "".join(
        f'<pre class="command">{escape(line)}</pre><p class="caption">in {escape(folder)}</p>'
        for line, folder in commands
    )
    later = " The first began the run, the others resumed it." if len(commands) > 1 else ""
    return f"<h2>The command</h2><p>What made this result.{later}</p>{lines}"


def _link(path: str, words: str) -> str:
    return f'<a href="{escape(quote(path, errors="surrogateescape"))}">{escape(words)}</a>'


def _size(size: int) -> str:
    return f"{size / 1e6:.2f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"
