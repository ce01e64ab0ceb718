"""Work in a child of this process, which has imported everything: it may die in every way, and starts at once."""

from __future__ import annotations

import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

# of a child that ended in an exception which the command line would have shown as a traceback
TRACEBACK = 70
# and in one that it would have told in a line
TOLD = 2


def start(work: Callable[[], int | None], said: Path, memory: int | None = None) -> int:
    """Begin some work in a child.

    Args:
        work: done there; what it returns is the child's exit status, and None is 0.
        said: where what it prints goes.
        memory: bytes of address space that it may take over what this process has.

    Returns:
        The child's process id.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    status = TRACEBACK
    try:
        out = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(out, 1)
        os.dup2(out, 2)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if memory is not None:
            have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (have + memory, have + memory))
        status = work() or 0
    except BaseException as error:
        from pop_fast.cli.errors import describe

        line = describe(error)
        if line is not None and "\n" not in line and len(line) < 1000:
            status = TOLD
            print(line, flush=True)
        else:
            traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def wait(pid: int) -> int:
    """Wait for a child; a signal that ended it is a negative status."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
