"""commands.json: the command that began a run, and those that resumed it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from pop_fast.errors import PopError
from pop_fast.io.read_back import parse_json

COMMANDS_FILE: Final = "commands.json"
_FIX: Final = "remove the file: nothing but the report reads it"


def commands_text(earlier: Path | None, words: Sequence[str]) -> str:
    """Return what commands.json holds: what it held, and a further command.

    Args:
        earlier: the folder of the run that is resumed; None begins anew.
        words: the command.
    """
    before = read_commands(earlier) if earlier is not None else []
    return json.dumps([*before, {"words": list(words), "folder": str(Path.cwd())}], indent=2) + "\n"


def read_commands(folder: Path) -> list[dict[str, Any]]:
    """Read the commands of a result folder, with the folders that they were given in; none where it keeps none.

    Raises:
        PopError: commands.json is damaged.
    """
    path = folder / COMMANDS_FILE
    if not path.is_file():
        return []
    found = parse_json(path.read_text(encoding="utf-8", errors="replace"), f"{path}:", _FIX)
    if not isinstance(found, list) or not all(_is_command(entry) for entry in found):
        raise PopError(f"{path}: is not a list of commands, as 'pop train' writes it; {_FIX}")
    return found


def _is_command(entry: Any) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("folder"), str):
        return False
    words = entry.get("words")
    return isinstance(words, list) and all(isinstance(word, str) for word in words)


def shell_line(words: Sequence[str]) -> str:
    """Write a command as a shell reads it."""
    return shlex.join(words)
