"""Files of other tools that are YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from zfusion.errors import InputError


def write_yaml(path: Path, header: str, document: Mapping[str, Any]) -> Path:
    """Write a document below a header of comments; `path`. InputError where the extra is missing."""
    try:
        import yaml  # noqa: PLC0415 - of an extra
    except ImportError:
        raise InputError(f"{path.name} needs PyYAML: pip install 'zfusion[deploy]'") from None
    path.write_text(f"{header}\n{yaml.safe_dump(document, sort_keys=False, width=120)}")
    return path
