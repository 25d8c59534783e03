"""Certificates that are no good are found before anything waits for them, by file and reason."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from zfusion.deploy.authority import Authority, make_authority, read_authority
from zfusion.deploy.identity import write_private
from zfusion.drivers.credentials import Credentials, dialled_at, dialled_under, prove
from zfusion.errors import InputError


def authority(directory: Path, name: str = "zfusion") -> Authority:
    directory.mkdir(parents=True)
    certificate, key = make_authority(name, 3650)
    (directory / "ca.pem").write_bytes(certificate)
    write_private(directory / "ca.key", key)
    return read_authority(directory / "ca.pem", directory / "ca.key")


def credentials(
    directory: Path,
    signer: Authority,
    name: str = "node-1",
    address: str = "10.0.0.1",
    *,
    days: float = 10,
    age: timedelta = timedelta(),
) -> Credentials:
    directory.mkdir(parents=True, exist_ok=True)
    certificate, key = signer.issue(name, address, days, datetime.now(UTC) - age)
    files = Credentials(directory / "ca.pem", directory / "x.pem", directory / "x.key")
    files.authority.write_bytes(signer.pem)
    files.certificate.write_bytes(certificate)
    write_private(files.key, key)
    return files


def refusal(files: Credentials, **expected: str) -> str:
    with pytest.raises(InputError) as caught:
        prove(files, **expected)
    return str(caught.value)


@pytest.mark.parametrize("address", ["10.0.0.1", "2001:db8::1", "sensor-1.example.org"])
def test_good_ones_are_proven(tmp_path: Path, address: str) -> None:
    files = credentials(tmp_path / "tls", authority(tmp_path / "ca"), address=address)
    proven = prove(files, common_name="node-1", address=address)
    assert proven.common_name == "node-1"
    assert timedelta(days=9) < proven.ends - datetime.now(UTC) < timedelta(days=11)
    assert files.key.stat().st_mode & 0o777 == 0o600


def test_time_name_and_address(tmp_path: Path) -> None:
    signer = authority(tmp_path / "ca")
    expired = credentials(tmp_path / "expired", signer, days=1, age=timedelta(days=2))
    early = credentials(tmp_path / "early", signer, age=timedelta(days=-2))
    good = credentials(tmp_path / "good", signer)
    assert refusal(expired) == f"{expired.certificate}: it has expired: make new ones with zfusion deploy --renew"
    assert refusal(early).startswith(f"{early.certificate}: it is not valid yet: look at this machine's clock")
    assert "is the certificate of 'node-1', and this process is 'node-2'" in refusal(good, common_name="node-2")
    assert "of another address than this host's" in refusal(good, address="10.0.0.2")
    assert "of another name than this host's" in refusal(good, address="sensor-1.example.org")


def test_another_authority(tmp_path: Path) -> None:
    ours, theirs = authority(tmp_path / "ours"), authority(tmp_path / "theirs", "somebody")
    files = credentials(tmp_path / "tls", theirs)
    files.authority.write_bytes(ours.pem)
    assert refusal(files) == f"{files.certificate}: it is not signed by this run's CA"
    certificate, key = make_authority("node-1", 10)
    files.certificate.write_bytes(certificate)
    write_private(files.key, key)
    assert str(files.certificate) in refusal(files)


def test_keys(tmp_path: Path) -> None:
    signer = authority(tmp_path / "ca")
    files, other = credentials(tmp_path / "tls", signer), credentials(tmp_path / "other", signer)
    files.key.chmod(0o644)
    assert refusal(files) == f"{files.key}: everybody on this machine may read or change this key: chmod 600 it"
    files.key.chmod(0o640)
    prove(files)  # a group may, as where secrets are mounted
    key = load_pem_private_key(files.key.read_bytes(), None)
    locked = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret"))
    write_private(files.key, locked)
    assert refusal(files) == f"{files.key}: it is encrypted: expected a key without a passphrase"
    write_private(files.key, other.key.read_bytes())
    assert refusal(files) == f"{files.key}: it is not the key of {files.certificate}"


@pytest.mark.parametrize("name", ["authority", "certificate", "key"])
def test_files(tmp_path: Path, name: str) -> None:
    files = credentials(tmp_path / "tls", authority(tmp_path / "ca"))
    file: Path = getattr(files, name)
    file.write_bytes(b"nothing of the kind")
    assert str(file) in refusal(files)
    assert "in PEM" in refusal(files)
    file.unlink()
    assert refusal(files) == f"{file}: cannot be read (No such file or directory)"


def test_both_ends_of_a_configuration_are_looked_at(tmp_path: Path) -> None:
    tls = {
        "root_ca_certificate": "ca.pem",
        "listen_certificate": "a.pem",
        "listen_private_key": "a.key",
        "connect_certificate": "b.pem",
        "connect_private_key": None,
    }
    assert Credentials.of(tls) == [Credentials(Path("ca.pem"), Path("a.pem"), Path("a.key"))]
    tls["connect_private_key"] = "b.key"
    assert [files.certificate.name for files in Credentials.of(tls)] == ["a.pem", "b.pem"]
    assert Credentials.of({}) == []


def test_where_a_process_is_dialled_is_read_from_metadata_that_may_be_anything() -> None:
    assert dialled_at(dialled_under("10.0.0.1")) == "10.0.0.1"
    for other in (None, "Penny Lane", [], {"location": "Penny Lane"}, {"zfusion": "x"}, {"zfusion": {"dialled_at": 1}}):
        assert dialled_at(other) is None
