"""`pop completion`: a script by which a shell completes the words of `pop`.

The script holds all words, so that pressing Tab starts no Python; it is written anew after an update.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import tyro

from pop_fast.cli import COMMANDS, command, parse

_EXAMPLES: Final = """
    eval "$(pop completion bash)"                                  in ~/.bashrc
    eval "$(pop completion zsh)"                                   in ~/.zshrc
    pop completion fish > ~/.config/fish/completions/pop.fish
"""
# at the start of a line of help, in one of the frames that are drawn beside each other where there is room
_OPTION: Final = re.compile(r"(?:^|  )[│| ]*(-{1,2}[a-zA-Z][\w.-]*(?:, --[\w.-]+)*)", re.MULTILINE)
_WORD: Final = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
_BASH: Final = """_pop() {{
  local current="${{COMP_WORDS[COMP_CWORD]}}" command="${{COMP_WORDS[1]}}" words=""
  if [[ $COMP_CWORD -eq 1 ]]; then
    words="{commands}"
  else
    case "$command" in
{cases}
    esac
    [[ $current == -* ]] || words=$([[ $command == data && $COMP_CWORD -eq 2 ]] && echo check)
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
# files by the shell's own completion, which knows spaces and ~
complete -o default -F _pop pop
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Write a script by which a shell completes commands, options and files after `pop`."""

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """Which shell."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "completion", examples=_EXAMPLES)
    words = {name: options_of(name) for name in COMMANDS}
    print(fish(words) if args.shell == "fish" else bash(words, args.shell == "zsh"), end="")
    return 0


def options_of(name: str) -> list[str]:
    """List the options of a subcommand, as its help shows them."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        command(name)(["--help-all" if name == "train" else "--help"])
    shown = text.getvalue()
    found = {word for names in _OPTION.findall(shown) for word in _WORD.findall(names)}
    return sorted(found)


def bash(words: dict[str, list[str]], zsh: bool = False) -> str:
    """Write the script for bash, which zsh runs too when asked to."""
    first = dict.fromkeys(name.split()[0] for name in words)
    options = {word: [o for name, found in words.items() if name.split()[0] == word for o in found] for word in first}
    cases = "\n".join(f'      {name}) words="{" ".join(found)}" ;;' for name, found in options.items())
    start = "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n" if zsh else ""
    return start + _BASH.format(commands=" ".join(first), cases=cases)


def fish(words: dict[str, list[str]]) -> str:
    """Write the script for fish."""
    lines: list[str] = []
    for name, options in words.items():
        first = name.split()[0]
        about = COMMANDS[name].replace("'", "\\'")
        lines.append(f"complete -c pop -n __fish_use_subcommand -a {first} -d '{about}'")
        lines += [
            f"complete -c pop -n '__fish_seen_subcommand_from {first}' -l {o.removeprefix('--')}" for o in options
        ]
        lines += [
            f"complete -c pop -n '__fish_seen_subcommand_from {first}' -a {name.split()[1]}" for _ in name.split()[1:]
        ]
    return "\n".join(lines) + "\n"
