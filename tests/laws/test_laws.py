"""Every law of the kit over every backend of our own that the law speaks to: a class for each module of laws."""

from __future__ import annotations

from tests.judged import LAW_MODULES, law_classes

globals().update(law_classes(LAW_MODULES))
