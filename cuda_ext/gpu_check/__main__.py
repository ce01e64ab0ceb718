"""Entry point of `python3 -m cuda_ext.gpu_check`."""

import signal
import sys

from cuda_ext.gpu_check.command import main

# a job that is ended takes its commands, which have sessions of their own, along
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
sys.exit(main())
