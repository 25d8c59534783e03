"""zfusion: peer-to-peer state estimation in sensor networks, on Eclipse Zenoh.

The front door is the command line (``zfusion --help``) and `zfusion.model.scenario`; the file to read first is
`zfusion.node`.
"""

from typing import TYPE_CHECKING

__version__: str

if not TYPE_CHECKING:

    def __getattr__(name: str) -> str:
        """The version, looked up when somebody asks: that takes a while, and nobody listens to Ctrl-C before."""
        if name == "__version__":
            from importlib.metadata import version  # noqa: PLC0415

            return version(__name__)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
