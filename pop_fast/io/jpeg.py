"""Find JPEG files whose coded pixels are damaged, which decoders fill with gray or wrong colours without an error.

OpenCV reports nothing when libjpeg finds damage in the coded pixels: libjpeg itself prints a line on standard error,
which belongs to the whole process. So a process in which nothing else happens decodes the files in turn, and announces
each on standard error by a NUL and its number: then every line can be assigned to its file.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from pop_fast.children import module_command
from pop_fast.errors import CaptureError
from pop_fast.io.images import FIX

# a process takes as long to start as to read so many
_A_LISTENER_FOR = 64
_LISTENERS = 4
_DAMAGE = re.compile(
    rb"premature end of data segment|bad Huffman code|bad arithmetic code|found marker \w+ instead of RST\d"
    rb"|Premature end of JPEG file|(\d+) extraneous bytes before marker \w+"
)
# some cameras pad the coded pixels with a few bytes
_PADDING = 64


@contextmanager
def jpeg_damage(paths: Sequence[Path]) -> Iterator[dict[Path, str]]:
    """Listen to what libjpeg says of photographs, while the block reads them or does anything else.

    The files are decoded a second time, small, in up to four further processes; see `main`.

    Args:
        paths: photographs of any format; only JPEG files are listened to.

    Yields:
        One line for every damaged file, in the order of `paths`; filled in when the block ends without an error.
    """
    files = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg")]
    count = min(_LISTENERS, os.cpu_count() or 1, -(-len(files) // _A_LISTENER_FOR)) if sys.executable else 0
    shares = [files[start::count] for start in range(count)]
    found: dict[Path, str] = {}
    with ExitStack() as stack:
        logs = [stack.enter_context(tempfile.TemporaryFile()) for _ in shares]
        listeners = [_listen(stack, share, log) for share, log in zip(shares, logs, strict=True)]
        yield found
        damage: dict[Path, str] = {}
        for share, log, listener in zip(shares, logs, listeners, strict=True):
            listener.wait()
            damage |= _damage(share, log)
        for path in files:
            if path in damage:
                found[path] = f"{path}: the JPEG file is corrupt: {damage[path]}; {FIX}"


@contextmanager
def sound_jpegs(paths: Sequence[Path]) -> Iterator[None]:
    """Refuse damaged JPEG files when the block that reads them has ended without an error.

    Raises:
        CaptureError: names the first of them.
    """
    with jpeg_damage(paths) as damage:
        yield
    for message in damage.values():
        raise CaptureError(message)


def _listen(stack: ExitStack, files: Sequence[Path], log: IO[bytes]) -> subprocess.Popen[bytes]:
    command = module_command(__name__)
    # a file and not a pipe, which would have to be fed while the block runs
    with tempfile.TemporaryFile() as names:
        names.write(b"\0".join(os.fsencode(path.absolute()) for path in files))
        names.seek(0)
        listener = subprocess.Popen(command, stdin=names, stdout=subprocess.DEVNULL, stderr=log)
    stack.callback(listener.wait)
    stack.callback(listener.kill)
    return listener


def _damage(files: Sequence[Path], log: IO[bytes]) -> dict[Path, str]:
    """Read what was said of each file, and keep what means lost pixels."""
    log.seek(0)
    found: dict[Path, str] = {}
    for said in log.read().split(b"\0")[1:]:
        number, _, words = said.partition(b"\n")
        complaint = _DAMAGE.search(words)
        if complaint and int(complaint[1] or _PADDING + 1) > _PADDING:
            found[files[int(number)]] = complaint[0].decode("ascii")
    return found


def main() -> None:
    """Decode the JPEG files whose names standard input holds, separated by NUL."""
    for number, name in enumerate(sys.stdin.buffer.read().split(b"\0")):
        os.write(2, b"\0%d\n" % number)
        try:
            # an eighth of the size: all coded pixels are read, and few computed
            cv2.imdecode(np.fromfile(os.fsdecode(name), np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8)
        except (OSError, cv2.error):
            continue  # whoever reads the photograph itself says so


if __name__ == "__main__":
    main()
