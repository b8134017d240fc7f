"""Certificates of a private authority, for TLS on the loopback."""

from __future__ import annotations

import datetime

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


def write_certificates(folder):
    """Write ``ca.pem``, and ``cert.pem`` signed by it with ``key.pem``; return the three paths."""
    folder.mkdir(exist_ok=True)
    authority, own = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    name = _name("test authority")
    # Python 3.13 refuses certificates without key identifiers and key usage.
    use = x509.KeyUsage(False, False, False, False, False, True, False, False, False)
    root = _signed(_builder(name, name, authority, authority, authority=True).add_extension(use, True), authority)
    leaf = _signed(_builder(_name("test node"), name, own, authority, authority=False), authority)
    paths = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    for path, one in zip(paths, (root, leaf), strict=False):
        path.write_bytes(one.public_bytes(serialization.Encoding.PEM))
    form = serialization.PrivateFormat.PKCS8
    paths[2].write_bytes(own.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption()))
    return tuple(map(str, paths))


def _name(text):
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _builder(name, issuer, key, signer, *, authority):
    now, day = datetime.datetime.now(datetime.UTC), datetime.timedelta(days=1)
    builder = x509.CertificateBuilder(issuer, name, key.public_key(), x509.random_serial_number(), now - day, now + day)
    for extension, critical in (
        (x509.BasicConstraints(ca=authority, path_length=None), True),
        (x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False),
        (x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), False),
    ):
        builder = builder.add_extension(extension, critical)
    return builder


def _signed(builder, key):
    return builder.sign(key, hashes.SHA256())
