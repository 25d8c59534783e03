"""A small CA: its certificate and key, and the certificates that it signs.

The only user of the cryptography library, which the extra `deploy` brings. Keys are on the curve P-256.
"""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import CertificateIssuerPrivateKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zfusion.drivers.credentials import keep_secret
from zfusion.errors import InputError

SKEW = timedelta(hours=1)
"""How long before now certificates are valid: machines whose clocks are late are to believe them, too."""

LONGEST_NAME = 64
"""Characters of a common name."""

SIGNS = x509.KeyUsage(
    digital_signature=False,
    content_commitment=False,
    key_encipherment=False,
    data_encipherment=False,
    key_agreement=False,
    key_cert_sign=True,
    crl_sign=True,
    encipher_only=False,
    decipher_only=False,
)
"""What a CA's key is for."""


@dataclass(frozen=True)
class Authority:
    """A CA that can sign."""

    certificate: x509.Certificate
    key: CertificateIssuerPrivateKeyTypes
    pem: bytes
    """The certificate's file."""

    def issue(self, common_name: str, address: str, days: float, start: datetime | None = None) -> tuple[bytes, bytes]:
        """A new certificate and its key, in PEM: of a process that is reached at `address`, from `start`, or now, on.

        It does not outlive the CA.
        """
        key, issuer = ec.generate_private_key(ec.SECP256R1()), self.certificate
        begin = datetime.now(UTC) if start is None else start
        until = min(begin + timedelta(days=days), issuer.not_valid_after_utc)
        both_ends = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        builder = (
            _builder(common_name, issuer.subject, key.public_key(), begin, until)
            .add_extension(x509.SubjectAlternativeName([_alternative(address)]), critical=False)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(both_ends, critical=False)
        )
        return builder.sign(self.key, hashes.SHA256()).public_bytes(Encoding.PEM), _pem_of(key)


def make_authority(common_name: str, days: int) -> tuple[bytes, bytes]:
    """A new CA: its certificate and its key, in PEM."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = common_name[:LONGEST_NAME]
    builder = (
        _builder(name, _name(name), key.public_key(), now, now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(SIGNS, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    return builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM), _pem_of(key)


def read_authority(certificate: Path, key: Path) -> Authority:
    """A CA from its files; InputError where they cannot be read, are none, or it has expired."""
    try:
        pem, secret = certificate.read_bytes(), key.read_bytes()
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read: {error.strerror}") from None
    keep_secret(key)
    try:
        signer = load_pem_private_key(secret, password=None)
    except (ValueError, TypeError):
        raise InputError(f"{key}: expected the CA's private key in PEM, without a passphrase") from None
    try:
        issuer = x509.load_pem_x509_certificate(pem)
    except ValueError:
        raise InputError(f"{certificate}: expected the CA's certificate in PEM") from None
    if issuer.public_key() != signer.public_key():
        raise InputError(f"{key}: it is not the key of {certificate}")
    if not _is_authority(issuer):
        raise InputError(f"{certificate}: it is no CA's certificate (basicConstraints: CA): it cannot sign others")
    if issuer.not_valid_after_utc <= datetime.now(UTC):
        raise InputError(f"{certificate}: this CA has expired: expected one that is valid")
    return Authority(issuer, signer, pem)  # type: ignore[arg-type]


def _is_authority(certificate: x509.Certificate) -> bool:
    try:
        return bool(certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca)
    except x509.ExtensionNotFound:
        return False


def _builder(
    common_name: str, issuer: x509.Name, key: ec.EllipticCurvePublicKey, begin: datetime, until: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_name(common_name))
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin - SKEW)
        .not_valid_after(until)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative(address: str) -> x509.GeneralName:
    """An address as certificates have it: IP addresses and names are of different kinds."""
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)


def _pem_of(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
