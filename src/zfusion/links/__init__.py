"""What becomes of messages on their way, and what happens to nodes and links: the same in every world.

    spec      zfusion.model.schema.links: what a scenario says
    protocol  a link: edge, message, time of sending -> times of arrival
    rules     what holds for one edge and stage
    lanes     what is drawn for them: delays, losses, duplicates
    network   the links of a scenario: the lanes, what limits their bandwidth, and the order of messages
    packets   the same for packets
    measured  the links of a run that was recorded
    topology  which edges there are at a step
    timeline  which nodes and links have what fault at a step

Every draw is a function of the scenario's seed, the edge, the stage and the step alone: whoever asks, in whatever
order, finds the same network. Nothing here reads a clock.
"""

from zfusion.links.measured import MeasuredLinks
from zfusion.links.network import LinkNetwork, links_of
from zfusion.links.packets import PacketModel
from zfusion.links.protocol import Edge, Link, ideal
from zfusion.links.timeline import Kill, Timeline
from zfusion.links.topology import Topology

__all__ = [
    "Edge",
    "Kill",
    "Link",
    "LinkNetwork",
    "MeasuredLinks",
    "PacketModel",
    "Timeline",
    "Topology",
    "ideal",
    "links_of",
]
