"""zfusion: peer-to-peer state estimation in sensor networks, on Eclipse Zenoh.

The front door is the command line (``zfusion --help``) and `zfusion.model.scenario`; the file to read first is
`zfusion.node`.
"""

from importlib.metadata import version

__version__ = version("zfusion")
