"""What a process proves of its TLS files before it opens a session, by nothing but the standard library.

Zenoh says little of a certificate that is no good: links do not come up, and a swarm waits for somebody who is there.
So each process shakes hands with itself first, in memory, as both ends of a link that ask each other for certificates:
what the others would refuse is refused here, with the file and the reason.
"""

from __future__ import annotations

import ssl
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zfusion.errors import InputError
from zfusion.model.types import NodeId

RECORDER_NAME = "recorder"
OBSERVER_NAME = "observer"

RENEW = "make new ones with zfusion deploy --renew"

REASONS: Mapping[int, str] = {
    9: "it is not valid yet: look at this machine's clock, and at the certificate's dates",
    10: f"it has expired: {RENEW}",
    18: "it is signed by itself and by no CA of this run",
    19: "its chain ends at a CA that is not this run's",
    20: "it is not signed by this run's CA",
    26: "its extended key usage does not allow for both ends of a link: clientAuth and serverAuth",
    62: "it is of another name than this host's",
    64: "it is of another address than this host's",
}
"""OpenSSL's codes of what is wrong with a certificate, in words; those that are not here come in OpenSSL's."""


def dialled_under(address: str) -> dict[str, Any]:
    """What Zenoh's free ``metadata`` say of a process that others dial: by which address, as certificates have it.

    The endpoints that it listens at do not tell: behind a NAT or in a container they are others.
    """
    return {"zfusion": {"dialled_at": address}}


def dialled_at(metadata: Any) -> str | None:
    """The address that `dialled_under` put there; None in a configuration that has none."""
    match metadata:
        case {"zfusion": {"dialled_at": str(address)}}:
            return address
    return None


def node_name(node: NodeId) -> str:
    """The common name of a node's certificate."""
    return f"node-{node}"


@dataclass(frozen=True, slots=True)
class Credentials:
    """The files that say who a process is."""

    authority: Path
    """Certificates of the CA."""
    certificate: Path
    key: Path

    @classmethod
    def of(cls, tls: Mapping[str, Any]) -> list[Credentials]:
        """Those of Zenoh's ``transport/link/tls``: to listen with, and to connect with; often the same."""
        found = (cls.at(tls, end) for end in ("listen", "connect"))
        return list(dict.fromkeys(files for files in found if files is not None))

    @classmethod
    def at(cls, tls: Mapping[str, Any], end: str) -> Credentials | None:
        """Those of one end of links, "listen" or "connect", if all of them are named."""
        files = [tls.get(name) for name in ("root_ca_certificate", f"{end}_certificate", f"{end}_private_key")]
        return cls(*(Path(str(file)) for file in files)) if all(isinstance(file, str) for file in files) else None


@dataclass(frozen=True, slots=True)
class Proven:
    """What credentials that are in order say."""

    common_name: str
    ends: datetime
    """When the certificate expires."""


def prove(credentials: Credentials, *, common_name: str | None = None, address: str | None = None) -> Proven:
    """What the credentials say, if the others of the run will believe them.

    InputError, naming file, reason and remedy: where a file cannot be read, a key may be read by all or is not the
    certificate's, a certificate is not of the CA or not of this time, or of another name or address than those given.
    """
    for file in (credentials.authority, credentials.certificate, credentials.key):
        _readable(file)
    keep_secret(credentials.key)
    subject, ends = _shake_hands(credentials, address)
    if common_name is not None and subject != common_name:
        told = f"{credentials.certificate}: it is the certificate of {subject!r}, and this process is {common_name!r}"
        raise InputError(f"{told}: give it the Zenoh configuration that was made for it")
    return Proven(subject, ends)


def keep_secret(key: Path) -> None:
    """InputError where a key is no secret."""
    if key.stat().st_mode & (stat.S_IROTH | stat.S_IWOTH):
        raise InputError(f"{key}: everybody on this machine may read or change this key: chmod 600 it")


def _readable(file: Path) -> None:
    try:
        with file.open("rb"):
            return
    except OSError as error:
        where = "" if file.is_absolute() else f" in {Path.cwd()}: start in the folder that zfusion deploy made"
        raise InputError(f"{file}: cannot be read ({error.strerror}){where}") from None


def _shake_hands(credentials: Credentials, address: str | None) -> tuple[str, datetime]:
    """The common name and the end of validity, told by a handshake of two ends that both use these files."""
    server, client = (_context(credentials, purpose) for purpose in (ssl.PROTOCOL_TLS_SERVER, ssl.PROTOCOL_TLS_CLIENT))
    client.check_hostname = address is not None
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(back, there, server_hostname=address),
        server.wrap_bio(there, back, server_side=True),
    )
    done: set[ssl.SSLObject] = set()
    while len(done) < len(ends):
        for end in ends:
            try:
                end.do_handshake()
                done.add(end)
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLCertVerificationError as error:
                raise InputError(f"{credentials.certificate}: {reason_of(error)}") from None
            except ssl.SSLError as error:
                raise InputError(f"{credentials.certificate}: TLS refuses it: {error.reason or error}") from None
    certificate = ends[0].getpeercert() or {}
    ends_at = ssl.cert_time_to_seconds(str(certificate["notAfter"]))
    return common_name_of(certificate), datetime.fromtimestamp(ends_at, UTC)


def _context(credentials: Credentials, purpose: int) -> ssl.SSLContext:
    context = ssl.SSLContext(purpose)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_REQUIRED

    def no_passphrase() -> str:
        raise InputError(f"{credentials.key}: it is encrypted: expected a key without a passphrase")

    try:
        context.load_verify_locations(credentials.authority)
    except ssl.SSLError:
        raise InputError(f"{credentials.authority}: expected the CA's certificate in PEM") from None
    try:
        context.load_cert_chain(credentials.certificate, credentials.key, no_passphrase)
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise InputError(f"{credentials.key}: it is not the key of {credentials.certificate}") from None
        files = f"{credentials.certificate}, {credentials.key}"
        raise InputError(f"{files}: expected a certificate and its key in PEM ({error.reason or 'no PEM'})") from None
    return context


def common_name_of(certificate: Mapping[str, Any]) -> str:
    """The common name of a certificate as the ssl module tells of it; empty where it has none."""
    subject = dict(pair for pairs in certificate.get("subject", ()) for pair in pairs)
    return str(subject.get("commonName", ""))


def reason_of(error: ssl.SSLCertVerificationError) -> str:
    """What is wrong with a certificate, in words."""
    return REASONS.get(error.verify_code, error.verify_message)
