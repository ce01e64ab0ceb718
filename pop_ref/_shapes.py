"""Array types whose shapes are checked when jaxtyping is installed, and plain arrays when it is not.

`pop_ref` runs with numpy alone. Under the tests jaxtyping is installed, and beartype checks annotations of arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64, Int64
else:
    try:
        from jaxtyping import Bool, Float64, Int64
    except ImportError:

        class _Unchecked:
            def __getitem__(self, item: Any) -> Any:
                return np.ndarray

        Bool = Float64 = Int64 = _Unchecked()

__all__ = ["Bool", "Float64", "Int64"]
