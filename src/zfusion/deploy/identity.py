"""Who is who: a small CA and a certificate for each process of a plan, or a user's own, checked and copied.

What is there and still good is kept, so that a deployment can be written again; `renew` makes all certificates anew,
under the same CA. Keys never leave the files: they are not logged, recorded or passed on command lines.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zfusion.deploy.plan import Plan, Process
from zfusion.deploy.zenoh_file import AUTHORITY
from zfusion.drivers.credentials import Credentials, prove
from zfusion.errors import InputError

if TYPE_CHECKING:
    from zfusion.deploy.authority import Authority

CA_FOLDER = "ca"
"""Beside the hosts' folders; its key stays at home."""

CA_DAYS = 3650
"""How long the CA is valid at least: longer than the certificates, which are renewed under it."""


def private_directory(path: Path) -> Path:
    """A directory that only its owner may look into, made if need be."""
    path.mkdir(parents=True, exist_ok=True)
    path.chmod(0o700)
    return path


def write_private(path: Path, data: bytes) -> None:
    """Write a file that only its owner may read, and that was never to be read by others."""
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)


def credentials_of(folder: Path, process: Process) -> Credentials:
    """A process' files in its host's folder."""
    return Credentials(folder / AUTHORITY, folder / process.certificate, folder / process.key)


class Identities:
    """The certificates of a plan's processes. InputError where the extra is missing that makes them."""

    def __init__(self, plan: Plan, directory: Path, *, renew: bool = False) -> None:
        """`directory` is that of the hosts' folders."""
        self._plan, self._directory, self._renew = plan, directory, renew
        self._security = plan.hosts.security
        self.kept: list[str] = []
        """Whose certificates were good and stay."""
        self.made: list[str] = []
        """Who has got new ones."""
        if self._security.certificates is not None:
            self._prove_users_own()
        self._authority = None if self._security.certificates else self._given() or self._own()

    def write(self, process: Process) -> tuple[Path, Path, Path]:
        """See to it that a process has its files in its host's folder; InputError where its own are no good."""
        folder = self._directory / process.host
        private_directory(folder / "tls")
        address = self._plan.hosts.hosts[process.host].address
        credentials = credentials_of(folder, process)
        if self._authority is None:
            self._copy(process, credentials)
            self.made.append(f"{process.host}/{process.name}")
        elif not self._renew and self._still_good(self._authority, credentials, process, address):
            self.kept.append(f"{process.host}/{process.name}")
        else:
            self._issue(self._authority, credentials, process, address)
            self.made.append(f"{process.host}/{process.name}")
        return credentials.authority, credentials.certificate, credentials.key

    def _issue(self, authority: Authority, credentials: Credentials, process: Process, address: str) -> None:
        credentials.authority.write_bytes(authority.pem)
        certificate, key = authority.issue(process.name, address, self._security.days)
        write_private(credentials.key, key)
        credentials.certificate.write_bytes(certificate)
        prove(credentials, common_name=process.name, address=address)

    @staticmethod
    def _still_good(authority: Authority, credentials: Credentials, process: Process, address: str) -> bool:
        try:
            prove(credentials, common_name=process.name, address=address)
        except InputError:
            return False
        return credentials.authority.read_bytes() == authority.pem

    def _users_own(self, process: Process) -> Credentials:
        """The files that a user has for a process."""
        own = Path(str(self._security.certificates))
        return Credentials(own / "ca.pem", own / f"{process.name}.pem", own / f"{process.name}.key")

    def _prove_users_own(self) -> None:
        """InputError with all that is wrong in a user's own certificates."""
        wrong = []
        for process in self._plan.processes:
            try:
                address = self._plan.hosts.hosts[process.host].address
                prove(self._users_own(process), common_name=process.name, address=address)
            except InputError as error:
                wrong.append(str(error))
        if wrong:
            raise InputError("\n".join(dict.fromkeys(wrong)))

    def _copy(self, process: Process, credentials: Credentials) -> None:
        """A user's own certificate, which is good."""
        given = self._users_own(process)
        credentials.authority.write_bytes(given.authority.read_bytes())
        write_private(credentials.key, given.key.read_bytes())
        credentials.certificate.write_bytes(given.certificate.read_bytes())

    def _given(self) -> Authority | None:
        """A user's own CA."""
        ca = self._security.ca
        return None if ca is None else _authority_module().read_authority(Path(ca.certificate), Path(ca.key))

    def _own(self) -> Authority:
        """The CA of this deployment, made if it is not there yet."""
        folder = private_directory(self._directory / CA_FOLDER)
        files = folder / "ca.pem", folder / "ca.key"
        if files[0].exists() and not files[1].exists():
            raise InputError(
                f"{files[1]}: expected the key of {files[0].name}, to sign with: put it back while this runs; or take "
                f"{folder} away, for a new CA, under which no certificate that was made so far is good any more"
            )
        if not files[0].exists():
            made = _authority_module().make_authority
            certificate, key = made(f"zfusion {self._plan.run}", max(CA_DAYS, 2 * self._security.days))
            write_private(files[1], key)
            files[0].write_bytes(certificate)
        read: Authority = _authority_module().read_authority(*files)
        return read


def _authority_module() -> Any:
    """The module that makes certificates; InputError, naming the extra, where what it is made with is missing."""
    try:
        return import_module("zfusion.deploy.authority")
    except ImportError as error:
        raise InputError(f"making certificates needs {error.name}: pip install 'zfusion[deploy]'") from None
