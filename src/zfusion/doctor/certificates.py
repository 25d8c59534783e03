"""What a deployed folder proves of the processes that are to run from it: as they do themselves when they start."""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from zfusion.deploy.identity import credentials_of
from zfusion.deploy.plan import Process
from zfusion.doctor.finding import Finding, Topic
from zfusion.drivers.credentials import RENEW, prove
from zfusion.errors import InputError

TOPIC = Topic("certificates")

SOON = timedelta(days=30)


def check_certificates(
    folder: Path, processes: Iterable[Process], address: str, now: datetime | None = None
) -> Iterator[Finding]:
    """Files, permissions, chain, names and dates; `address` is the host's."""
    now, good, first = now or datetime.now(UTC), [], None
    for process in processes:
        files = credentials_of(folder, process)
        try:
            proven = prove(files, common_name=process.name, address=address)
        except InputError as error:
            what, _, remedy = str(error).rpartition(": ")
            why = f"{process.name} refuses to start: nobody else would believe it"
            yield TOPIC.error(str(error), why, remedy if what.count(": ") else f"copy the folder again, or {RENEW}")
            continue
        if files.key.stat().st_mode & (stat.S_IRGRP | stat.S_IWGRP):
            remedy = f"chmod 600 {files.key}, unless the group is there for just that"
            yield TOPIC.warning(f"{files.key}: its group may read it", "whoever has it can be this process", remedy)
        if proven.ends - now < SOON:
            days = (proven.ends - now).days
            why = "from then on no link comes up any more; those that are up stay until they break"
            yield TOPIC.warning(f"{files.certificate} expires in {days} days", why, RENEW)
        good.append(process.name)
        first = min(first or proven.ends, proven.ends)
    if good and first is not None:
        yield TOPIC.ok(f"{', '.join(good)}: believed by the others until {first:%Y-%m-%d}")
