"""A page that holds all that it shows: one style, one script, and a policy by which nothing else runs or is fetched."""

from __future__ import annotations

import base64
import hashlib
from html import escape
from importlib.resources import files
from typing import Final

# pictures and videos are in the page; whatever else a text of a result or of a capture could bring along is neither
# fetched nor run
_POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; "
    "form-action 'none'; script-src {scripts}"
)
# the page that shows a splat sorts in a worker, and a frame is held to the policy of the page around it as well
_WORKERS: Final = " blob:; worker-src blob:"


def document(title: str, style: str, body: str, script: str, framed: str = "") -> str:
    """Lay out a page.

    Args:
        title: as text; it is escaped.
        style: its style sheet.
        body: what stands in `main`, as HTML.
        script: the one script that may run in it.
        framed: the one that may run in its frames, which may start workers; empty for none.
    """
    allowed = " ".join(f"'sha256-{_digest(text)}'" for text in (script, framed) if text)
    policy = _POLICY.format(scripts=allowed) + (_WORKERS if framed else "")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{escape(title)}</title><style>{style}</style></head>"
        f"<body><main>{body}</main><script>{script}</script></body></html>\n"
    )


def asset(folder: str, name: str) -> str:
    """Return a text file of a folder of this one."""
    return files("pop_fast.view").joinpath(folder, name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
