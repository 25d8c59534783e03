"""The accounts of a recording's topics: what came of what was sent, by the senders' own counters and last words."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict

from zfusion.errors import MessageError
from zfusion.gaps import MAX_LIVES, GapCounter, Gaps
from zfusion.messages import Stamp, decode_any, read_stamp
from zfusion.recording.layout import MAX_TOPICS, unsealed
from zfusion.stages import EVENT, TRUTH

_UNKNOWN = Stamp(0, 0, 0, 0)
_EVENTS = f"/{EVENT.name}"


class Accounts:
    """Keeps account of every topic. `observe` is called for each message, in the order in which they came."""

    def __init__(self) -> None:
        self.is_legal: Callable[[str, bytes], bool] = lambda _topic, _data: True
        """Asked where counters are not the next in order: what is not legal does not count."""
        self.is_topic: Callable[[str], bool] = lambda _topic: True
        """Asked of topics of which a sender says how much it had sent."""
        self._counters: dict[str, GapCounter] = {}
        self._sent: dict[str, dict[int, int]] = {}

    def observe(self, topic: str, data: bytes) -> Stamp:
        """A message came; its counters and time, or zeros where it has none."""
        counter = self._counters.get(topic)
        if counter is None:
            counter = self._counters[topic] = GapCounter()
        try:
            stamp = read_stamp(data)
        except MessageError:
            counter.observe_unreadable()
            return _UNKNOWN
        if counter.expects(stamp.born, stamp.seq) or self.is_legal(topic, data):
            counter.observe(stamp.born, stamp.seq)
        else:
            counter.observe_unreadable()
        if topic.endswith(_EVENTS):
            self._note_totals(topic, data)
        return stamp

    def gaps(self, sent: Mapping[str, Mapping[int, int]] | None = None) -> dict[str, Gaps]:
        """The accounts by topic; `sent` tells how many messages there were on topics, by the senders' lives.

        Where it says nothing, what the senders said themselves when they left does.
        """
        totals: Mapping[str, Mapping[int, int]] = {**self._sent, **(sent or {})}
        found = {topic: counter.gaps(totals.get(topic)) for topic, counter in self._counters.items()}
        return found | {topic: GapCounter().gaps(of) for topic, of in totals.items() if topic not in found}

    def _note_totals(self, topic: str, data: bytes) -> None:
        """What a leaving node says that it has sent."""
        try:
            event = decode_any(data)
        except MessageError:
            return
        details = event.get("data")
        if event.get("kind") != "stopped" or not isinstance(details, dict):
            return
        sent = details.get("sent")
        if not isinstance(sent, dict):
            return
        run = topic.rsplit("/", 3)[0]
        for stage, count in sent.items():
            if isinstance(count, int) and isinstance(stage, str):
                key = f"{run}/{TRUTH.name}" if stage == TRUTH.name else topic.removesuffix(EVENT.name) + stage
                self._note_total(key, event["born"], count)

    def _note_total(self, topic: str, born: int, count: int) -> None:
        if self.is_topic(topic) and (topic in self._sent or len(self._sent) < MAX_TOPICS):
            lives = self._sent.setdefault(topic, {})
            if born in lives or len(lives) < MAX_LIVES:
                lives[born] = count


def stated_accounts(metadata: Mapping[str, str]) -> dict[str, Gaps]:
    """The accounts that a file states."""
    return {topic: Gaps(**json.loads(account)) for topic, account in unsealed(metadata).items()}


def to_state(accounts: Mapping[str, Gaps]) -> dict[str, str]:
    """The accounts as a file states them."""
    return {topic: json.dumps(asdict(account)) for topic, account in accounts.items()}
