"""The types that every module of the model shares."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from zfusion.errors import InputError

Array = NDArray[np.float64]
"""Vectors (n,) and matrices (rows, columns) of float64; read-only wherever a model object holds one."""

NodeId = int | str
"""A sensor's name. All ids of one system are of one kind, so that they have an order."""


def sorted_ids(ids: Iterable[NodeId]) -> list[NodeId]:
    """In their one order, in which everything is stacked and folded. InputError if numbers and names are mixed."""
    ids = list(ids)
    if len({isinstance(i, str) for i in ids}) > 1:
        raise InputError(f"expected ids that are all integers or all names: {ids}")
    return sorted(ids)
