"""How the benchmarks that have one number to a name tell them."""

from __future__ import annotations

import json
from collections.abc import Mapping


def tell(result: Mapping[str, float], as_json: bool) -> None:
    """A JSON object, or a line for each."""
    if as_json:
        print(json.dumps(result))
        return
    for name, value in result.items():
        print(f"{name:32} {value}")
