"""The inbox: every wait ends, no message is lost, and the bell is heard by nobody else."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator

import pytest
import zenoh

from swarms import wait_until
from zfusion.drivers import inbox as inbox_module
from zfusion.drivers.clocks import Clock
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inbox import POSTED, POSTED_BYTES, STRETCH_NS, Inbox, Letter, Posted, Wake
from zfusion.drivers.transport import RECEIPT, open_session
from zfusion.swarm.ports import free_endpoints

SOON_NS = 20_000_000_000
"""Far later than anything here takes; a wait that lasts until then has not been ended."""


class Pair:
    """Two linked sessions, an inbox in one of them."""

    def __init__(self) -> None:
        [endpoint] = free_endpoints(1)
        self.session = open_session(Endpoints(listen=(endpoint,)))
        self.peer = open_session(Endpoints(connect=(endpoint,)))
        self.clock = Clock()
        self.inbox = Inbox(self.session, self.clock)
        self.closed = False

    def subscribe(self, *names: str, capacity: int = 1000) -> None:
        """Channels that the peer knows of."""
        for name in names:
            self.inbox.subscribe(name, f"test/{name}", capacity)
        token = self.session.liveliness().declare_token("test/token")
        watch = self.peer.liveliness().declare_subscriber("test/token", zenoh.handlers.FifoChannel(4), history=True)
        wait_until(watch.handler.try_recv, "the link")
        token.undeclare()
        watch.undeclare()

    def put(self, name: str, data: bytes) -> None:
        self.peer.put(f"test/{name}", data, congestion_control=zenoh.CongestionControl.BLOCK)

    def next(self, name: str) -> bytes:
        """The next message, however often the wait is ended by something else."""
        end = time.time_ns() + SOON_NS
        while time.time_ns() < end:
            letter = self.inbox.wait(name, end)
            if letter is not None:
                return letter[0]
            self.inbox.notices.clear()
        pytest.fail(f"nothing came on {name}")

    def close(self) -> float:
        """Close everything; how long that took, in seconds."""
        began = time.monotonic()
        if not self.closed:
            self.closed = True
            self.inbox.close()
            self.session.close()
            self.peer.close()
        return time.monotonic() - began


def payload(letter: Letter | None) -> bytes | None:
    """What is in a letter."""
    return None if letter is None else letter[0]


def arrived(pair: Pair, name: str) -> list[bytes]:
    """All that is there."""
    found = list(pair.inbox.arrived(name, bytes))
    assert all(content == letter[0] for content, letter in found)
    return [content for content, _ in found]


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.close()


def test_a_message_ends_a_wait(pair: Pair) -> None:
    pair.subscribe("a")
    pair.put("a", b"one")
    assert pair.next("a") == b"one"
    threading.Timer(0.05, pair.put, ("a", b"two")).start()
    assert pair.next("a") == b"two"
    assert arrived(pair, "a") == []


def test_a_deadline_ends_a_wait(pair: Pair) -> None:
    pair.subscribe("a")
    for wait_ns in (2_000_000, 50_000_000):
        deadline = time.time_ns() + wait_ns
        while time.time_ns() < deadline:
            assert pair.inbox.wait("a", deadline) is None
        assert time.time_ns() - deadline < 2_000_000_000
    assert pair.inbox.wait("a", time.time_ns() - 1) is None  # one that is over already


def test_a_long_wait_is_ended_for_a_change(pair: Pair) -> None:
    pair.subscribe("a")
    for deadline in (None, time.time_ns() + SOON_NS):
        began = time.time_ns()
        assert pair.inbox.wait("a", deadline) is None
        assert STRETCH_NS / 2 < time.time_ns() - began < 5_000_000_000


def test_a_notice_ends_a_wait(pair: Pair) -> None:
    pair.subscribe("a")
    for number in range(20):
        threading.Timer(0.001 * (number % 3), pair.inbox.notify, (number,)).start()
        end = time.time_ns() + SOON_NS
        while not pair.inbox.notices:
            assert time.time_ns() < end
            assert pair.inbox.wait("a", end) is None
        assert pair.inbox.notices.popleft() == number


def test_notices_that_are_left_while_others_are_taken_are_for_the_next_time(pair: Pair) -> None:
    for notice in (1, None, 2):
        pair.inbox.notify(notice)
    taken = []
    for number in pair.inbox.take_notices():
        pair.inbox.notify(number + 10)
        taken.append(number)
    assert taken == [1, 2]
    assert list(pair.inbox.take_notices()) == [11, 12]


def test_a_notice_that_is_there_lets_nobody_wait(pair: Pair) -> None:
    pair.subscribe("a")
    pair.inbox.notify("note")
    assert pair.inbox.wait("a", None) is None
    assert not pair.inbox.rest(time.time_ns() + SOON_NS)
    pair.put("a", b"message")
    wait_until(lambda: payload(pair.inbox.wait("a", None)) == b"message", "a message comes through all the same")


def test_rest_ends_with_its_time_or_a_notice(pair: Pair) -> None:
    until = pair.clock.now() + 30_000_000
    assert pair.inbox.rest(until)
    assert 0 <= pair.clock.now() - until < 2_000_000_000
    assert pair.inbox.rest(time.time_ns() - 1)
    threading.Timer(0.02, pair.inbox.notify, ("note",)).start()
    assert not pair.inbox.rest(time.time_ns() + SOON_NS)
    assert list(pair.inbox.notices) == ["note"]


def test_notify_may_be_used_in_a_signal_handler_at_any_moment(pair: Pair) -> None:
    pair.subscribe("a")
    before = signal.signal(signal.SIGALRM, lambda *_: pair.inbox.notify("alarm"))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.001, 0.0007)
        heard = 0
        end = time.time_ns() + SOON_NS
        while heard < 300:
            assert time.time_ns() < end
            if heard % 2:
                pair.inbox.rest(end)
            else:
                pair.inbox.wait("a", end)
            heard += len(pair.inbox.notices)
            pair.inbox.notices.clear()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_nothing_is_lost_or_reordered_whatever_ends_the_waits(pair: Pair) -> None:
    pair.subscribe("a", "b", capacity=64)
    count = 4000
    noise = threading.Event()

    def talk(name: str) -> None:
        for number in range(count):
            pair.put(name, b"%d" % number)

    def disturb() -> None:
        while not noise.wait(0.0005):
            pair.inbox.notify("noise")

    threads = [threading.Thread(target=talk, args=(name,), daemon=True) for name in ("a", "b")]
    threads.append(threading.Thread(target=disturb, daemon=True))
    for thread in threads:
        thread.start()
    heard: dict[str, list[bytes]] = {"a": [], "b": []}
    end = time.monotonic() + 60
    turn = 0
    while any(len(messages) < count for messages in heard.values()):
        assert time.monotonic() < end, {name: len(messages) for name, messages in heard.items()}
        turn += 1
        letter = pair.inbox.wait("ab"[turn % 2], time.time_ns() + turn % 5 * 100_000)
        if letter is not None:
            heard["ab"[turn % 2]].append(letter[0])
        pair.inbox.notices.clear()
        if turn % 7 == 0:
            for name in "ab":
                heard[name].extend(arrived(pair, name))
    noise.set()
    for thread in threads:
        thread.join()
    assert heard == {name: [b"%d" % number for number in range(count)] for name in ("a", "b")}
    assert arrived(pair, "a") == []
    assert arrived(pair, "b") == []


def test_taking_what_arrives_has_an_end_though_more_arrives_all_the_while(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair.subscribe("a")
    monkeypatch.setattr(inbox_module, "CHANNEL", 10)
    for number in range(25):
        pair.put("a", b"%d" % number)
    wait_until(lambda: pair.inbox.poll_sample("a"), "the first")  # what was put before them is there by now or later
    taken: list[int] = []

    def read(data: bytes) -> int | None:
        taken.append(int(data))
        return None if int(data) % 2 else int(data)

    def go_on() -> bool:
        before = len(taken)
        assert [content for content, _ in pair.inbox.arrived("a", read)] == [n for n in taken[before:] if n % 2 == 0]
        assert len(taken) <= before + 10
        return len(taken) == 24

    wait_until(go_on, "the last")
    assert taken == list(range(1, 25))


def test_a_full_channel_does_not_keep_another_one_waiting_for_ever(pair: Pair) -> None:
    pair.subscribe("full", "other", capacity=8)
    for number in range(100):
        pair.put("full", b"%d" % number)
    pair.put("other", b"behind")
    end = time.time_ns() + SOON_NS
    heard: list[bytes] = []
    found = None
    while found is None:
        assert time.time_ns() < end
        found = payload(pair.inbox.wait("other", end))
        heard.extend(arrived(pair, "full"))
    assert found == b"behind"
    assert heard[:90] == [b"%d" % number for number in range(90)]


def test_closing_with_full_channels_is_quick(pair: Pair) -> None:
    pair.subscribe("a", "b", capacity=4)
    for number in range(50):
        pair.put("a", b"%d" % number)
        pair.put("b", b"%d" % number)
    wait_until(lambda: arrived(pair, "a"), "the channels fill up")
    assert pair.close() < 5.0


def test_an_expression_has_its_bell_on_a_key_of_its_own(pair: Pair) -> None:
    pair.inbox.subscribe("all", "test/**", 100, bell="test/bell")
    pair.subscribe()
    sample = pair.inbox.wait_sample("all", time.time_ns() + 1_000_000)
    assert str(sample.key_expr) == "test/bell"
    pair.put("x", b"message")
    wait_until(lambda: arrived(pair, "all") == [b"message"], "a message")


def test_a_bell_does_not_leave_the_session(pair: Pair) -> None:
    pair.subscribe("a")
    overheard = pair.peer.declare_subscriber("test/**", zenoh.handlers.FifoChannel(100))
    for _ in range(5):
        pair.inbox.wait("a", time.time_ns() + 1_000_000)
    pair.put("a", b"end")
    assert pair.next("a") == b"end"
    assert overheard.handler.recv().payload.to_bytes() == b"end"  # the peer's own, and nothing before it
    overheard.undeclare()


def test_a_wake_that_is_set_before_the_wait_ends_it_once() -> None:
    wake = Wake()
    wake.set()
    wake.set()
    wake.wait(60)
    began = time.monotonic()
    wake.wait(0.02)
    assert time.monotonic() - began >= 0.02


def test_a_letter_says_when_it_was_looked_at_and_if_its_sender_wants_when_it_came(pair: Pair) -> None:
    pair.subscribe("a")
    before, before_by_the_machine = pair.clock.now(), time.time_ns()
    pair.put("a", b"plain")
    pair.peer.put("test/a", b"stamped", timestamp_instrumentation=RECEIPT)
    letters: list[Letter] = []
    while len(letters) < 2:
        assert pair.clock.now() < before + SOON_NS
        letter = pair.inbox.wait("a", before + SOON_NS)
        letters += [] if letter is None else [letter]
    (plain, looked, received), (stamped, looked_next, received_next) = letters
    assert (plain, received, stamped) == (b"plain", None, b"stamped")
    assert received_next is not None
    assert before <= looked <= looked_next <= pair.clock.now()
    assert before_by_the_machine <= received_next <= time.time_ns()


def test_what_is_posted_comes_in_order_with_its_time_and_ends_a_rest_that_minds_it(pair: Pair) -> None:
    for name in "ab":
        pair.inbox.subscribe_posted(name, f"test/{name}")
    pair.subscribe()
    before = pair.clock.now()
    pair.put("a", b"one")
    pair.put("b", b"two")
    pair.put("a", b"three")
    wait_until(lambda: len(pair.inbox.posted) == 3, "three messages")
    assert not pair.inbox.rest(before + SOON_NS, or_posted=True)
    letters = [letter for _ in range(4) if (letter := pair.inbox.posted.take())]
    assert [(source, data) for source, data, _ in letters] == [("a", b"one"), ("b", b"two"), ("a", b"three")]
    times = [at for *_, at in letters]
    assert before <= times[0] <= times[1] <= times[2] <= pair.clock.now()
    assert pair.inbox.rest(time.time_ns() + 1_000_000)  # who does not mind what is posted sleeps on
    threading.Timer(0.05, pair.put, ("b", b"four")).start()
    assert not pair.inbox.rest(before + SOON_NS, or_posted=True)


def test_what_is_posted_does_not_fill_the_memory(pair: Pair) -> None:
    pair.inbox.subscribe_posted("a", "test/a")
    pair.subscribe()
    for _ in range(POSTED - 1):
        pair.inbox.posted.add("a", b"", 0)
    pair.put("a", b"fits")
    pair.put("a", b"does not")
    wait_until(lambda: pair.inbox.overrun, "a message too many")
    assert (len(pair.inbox.posted), pair.inbox.overrun) == (POSTED, 1)
    letters = [pair.inbox.posted.take() for _ in range(POSTED)]
    assert letters[-1] is not None
    assert letters[-1][1] == b"fits"
    assert pair.inbox.posted.take() is None


def test_few_large_messages_that_are_posted_do_not_fill_the_memory() -> None:
    posted, large = Posted(), bytes(POSTED_BYTES // 4)
    taken = [posted.add("a", large, n) for n in range(5)]
    assert taken == [True] * 4 + [False]
    assert posted.add("a", b"", 5)
    assert posted.take() == ("a", large, 0)
    assert posted.add("a", large, 6)
    assert not posted.add("a", b"1", 7)
    assert len(posted) == 5
