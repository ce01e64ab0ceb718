"""`report.html`: one self-contained page that shows how a training run went, made from the files it left."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.view.report.source import write_report

__all__ = ["write_report"]

# training colours its pictures with a module of this package, long before there is anything to report
__getattr__ = given_by(__name__, {"source": ("write_report",)})
