"""`python -m paper_repro` is `pop-repro`."""

from paper_repro.cli import main

raise SystemExit(main())
