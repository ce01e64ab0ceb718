"""The command line of the reproduction, `pop-repro`: arguments and printing only, one small module for each group.

What trains, draws or reads results is imported when its command is called, so that help and typing errors are quick.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Final

from pop_fast.errors import PopError

__all__ = ["COMMANDS", "EXIT_BAD_INPUT", "EXIT_INCOMPLETE", "EXIT_INTERRUPTED", "main"]

EXIT_INCOMPLETE: Final = 1
EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130

# each with its module and what it does
COMMANDS: Final = {
    "run": ("training", "train one row on one scene, or continue with it"),
    "queue": ("training", "train every row of a scale that is missing, the cheapest first"),
    "verify": ("verifying", "train a finished row again at its commit, and compare the bits"),
    "status": ("showing", "say which rows of a scale are done"),
    "table": ("showing", "make one of the paper's tables from the results"),
    "figure": ("showing", "draw one of the paper's figures from the results"),
    "claims": ("showing", "judge the paper's claims by the results"),
    "data check": ("data", "say which scenes are there, whole, and where to get the rest"),
}
_TEXT: Final = """\
usage: pop-repro COMMAND ...

Every method, table and figure of the paper, from nothing or from the results that are there.

commands:
{commands}

start here:
  pop-repro run pop demo --scale toy                    one row in seconds, without data
  pop-repro data check --data DATA                      what of the paper's scenes is there
  pop-repro queue --scale small --data DATA --nice 10     days of training, stopped and resumed at any time
  pop-repro table 1 --scale small                         the paper's first table from the results
  snakemake -s {snakefile} -n        the same as a workflow, for a cluster or a cloud

'pop-repro COMMAND --help' explains one. --debug (or POP_DEBUG=1) shows the traceback of an error."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and turn what went wrong into one line and an exit status.

    Args:
        argv: the words after `pop-repro`; the process's own when None.

    Returns:
        0, or 1 where something is missing or failed, or 2 for bad input and bad usage, or 130 after Ctrl-C or SIGTERM;
        of `run` also 69 where this version cannot train the row, and 75 where another process trains it.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words or os.environ.get("POP_DEBUG", "") not in ("", "0")
    try:
        status = _run([word for word in words if word != "--debug"])
        sys.stdout.flush()
        return status
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt:
        print("pop-repro: stopped; the same command continues from the last checkpoint", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # the reader has gone, as in `pop-repro status | head`: what is still buffered has nowhere to go
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        from pop_fast.cli import describe

        line = str(error) if isinstance(error, PopError) else describe(error)
        if debug or line is None:
            raise
        print(f"pop-repro: error: {line}", file=sys.stderr)
        return getattr(error, "status", EXIT_BAD_INPUT)


def parser_of(command: str, examples: str = "") -> argparse.ArgumentParser:
    """Make the parser of a subcommand.

    Args:
        command: its name.
        examples: shown under the options, one a line.
    """
    about = COMMANDS[command][1]
    return argparse.ArgumentParser(
        prog=f"pop-repro {command}",
        description=about[0].upper() + about[1:] + ".",
        epilog="examples:\n" + "\n".join(f"  {line.strip()}" for line in examples.strip().splitlines()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        width = max(map(len, COMMANDS)) + 2
        commands = "\n".join(f"  {name:<{width}}{about}" for name, (_, about) in COMMANDS.items())
        print(_TEXT.format(commands=commands, snakefile="paper_repro/Snakefile"))
        return 0
    for length in (2, 1):
        name = " ".join(words[:length])
        if name in COMMANDS:
            module = importlib.import_module(f"paper_repro.cli.{COMMANDS[name][0]}")
            return getattr(module, name.replace(" ", "_"))(words[length:])
    near = difflib.get_close_matches(words[0], [name.split()[0] for name in COMMANDS], n=1, cutoff=0.5)
    hint = f"did you mean 'pop-repro {near[0]}'?" if near else "see 'pop-repro --help'"
    print(f"pop-repro: error: '{words[0]}' is not a subcommand; {hint}", file=sys.stderr)
    return EXIT_BAD_INPUT
