"""What holds on one edge for one stage: the links of a scenario, all exceptions worked in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zfusion.links.protocol import Edge
from zfusion.model.schema.links import BandwidthSpec, BurstLoss, LinkRules, LinksSpec

PACKETS = "packet"
"""In the place of the stage: what is drawn for the packets of an edge, whatever they carry."""


@dataclass(frozen=True, slots=True)
class Rules:
    """What holds for one edge and stage: as `LinkRules`, all exceptions worked in."""

    delay: Any
    loss: float | BurstLoss
    duplicate: float
    reorder: bool
    bandwidth: BandwidthSpec | None

    @classmethod
    def of(cls, links: LinksSpec, edge: Edge, stage: str) -> Rules:
        """The rules of a scenario's links for this edge and stage."""
        rules = {name: getattr(links, name) for name in LinkRules.RULES}
        for exception in links.edges:
            if exception.concerns(edge) and (exception.stages is None or stage in exception.stages):
                rules |= exception.rules
        return cls(**rules)
