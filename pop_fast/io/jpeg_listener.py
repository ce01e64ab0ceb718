"""A program of its own: decode JPEG files in turn, each announced by a NUL and its number on standard error.

OpenCV hands nothing over when libjpeg finds damage in the coded pixels: libjpeg itself prints a line on standard error,
which belongs to the whole process. In a process where nothing else happens, the line can be assigned to its file.
"""

from __future__ import annotations

import os
import sys

import cv2
import numpy as np


def main() -> None:
    """Read the names from standard input, separated by NUL."""
    for number, name in enumerate(sys.stdin.buffer.read().split(b"\0")):
        os.write(2, b"\0%d\n" % number)
        try:
            # an eighth of the size: all coded pixels are read, and few computed
            cv2.imdecode(np.fromfile(os.fsdecode(name), np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8)
        except (OSError, cv2.error):
            continue  # whoever reads the photograph itself says so


if __name__ == "__main__":
    main()
